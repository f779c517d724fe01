"""Off-policy evaluation against known returns: every method of the panel on the synthetic participants and on two unrelated simulators.

    python benchmarks/ope.py --quick                     P1, one seed, four policies
    python benchmarks/ope.py --out FOLDER                P1 to P4, three seeds, eight policies
    python benchmarks/ope.py --simulator other --out FOLDER

Nothing is fitted or chosen by the true returns; they are computed to measure with. Finished cells are lines of FOLDER/cells.jsonl, and a
run that is started again skips them; the figure is FOLDER/ope.svg. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from figure import draw
from ope_policies import fixed_policies, trained_policies
from simulators import STEPS, WORLDS, World

from ml.ope.compare.aggregate import combine
from ml.ope.compare.metrics import accuracy
from ml.ope.compare.skill import choose_default, reach_with
from ml.ope.estimate import Estimate
from ml.ope.registry import AGGREGATE, estimators, quick_estimators
from ml.policies.policy import Policy
from ml.trajectories import ReplayBuffer

PARTICIPANT_WORLDS, OTHER_WORLDS = ("P1", "P2", "P3", "P4"), ("saturating", "switching")
VISITS = {"P1": 3, "P2": 4, "P3": 5, "P4": 6, "saturating": 4, "switching": 4}
KEPT = ("value", "low", "high", "step_return", "end_reward", "standard_error", "supported")


class Cells:
    """Finished cells, one JSON object per line, by their key."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._cells: dict[str, Any] = {}
        for line in path.read_text().splitlines() if path.exists() else []:
            # A line that an interrupted run cut short is no cell.
            if line.endswith("}"):
                cell = json.loads(line)
                self._cells[cell["key"]] = cell

    def get(self, key: str) -> Any:
        return self._cells.get(key)

    def add(self, key: str, **content: Any) -> dict[str, Any]:
        cell = {"key": key, **content}
        self._cells[key] = cell
        with self._path.open("a") as file:
            file.write(json.dumps(cell) + "\n")
        return cell

    def all(self, prefix: str) -> list[dict[str, Any]]:
        return [cell for key, cell in self._cells.items() if key.startswith(prefix)]


@dataclass(frozen=True)
class Run:
    """What one call of the benchmark measures."""

    cells: Cells
    out: Path
    quick: bool
    skip: frozenset[str]
    sessions: int


def prepare(world: World, seed: int, visits: int, run: Run) -> tuple[ReplayBuffer, dict[str, Policy]]:
    """Data and policies of one world and seed, and their true returns as a cell; fixed policies are measured once."""
    buffer = world.data(seed, visits)
    fixed = fixed_policies(buffer.settings.xi_beta, quick=run.quick)
    chosen = dict(fixed)
    if not run.quick:
        chosen |= trained_policies(buffer, seed, run.out / "policies" / f"{world.name}-{seed}")
    if run.cells.get(f"{world.name}/{seed}/truth") is None:
        found, on_days = {}, {}
        for name, policy in chosen.items():
            key = f"{world.name}/fixed/{name}"
            known = run.cells.get(key) if name in fixed else None
            if known is None:
                known = {"truth": asdict(world.truth(policy, run.sessions))}
                if name in fixed:
                    run.cells.add(key, **known)
            found[name] = known["truth"]
            there = world.truth_on_days(policy, seed, visits, max(20, run.sessions // 2))
            if there is not None:
                on_days[name] = asdict(there)
        run.cells.add(f"{world.name}/{seed}/truth", policies=found, on_days=on_days, sessions=len(buffer.sessions))
        told(f"{world.name}/{seed}: true returns")
    return buffer, chosen


def measure(world: World, seed: int, visits: int, run: Run) -> None:
    """All cells of one world and seed: truth, every method, the aggregate, and the choice by held-out skill."""
    cells, prefix = run.cells, f"{world.name}/{seed}"
    panel = {m: e for m, e in estimators(seed, demo=run.quick).items() if m not in run.skip}
    if all(cells.get(f"{prefix}/{m}") for m in (*panel, AGGREGATE, "choice")):
        return
    buffer, chosen = prepare(world, seed, visits, run)
    estimates: dict[str, dict[str, Estimate]] = {}
    for method, estimator in panel.items():
        if cells.get(f"{prefix}/{method}"):
            continue
        start = time.process_time()
        try:
            estimates[method] = estimator.fit(buffer).evaluate(chosen, STEPS)
        except ValueError as error:
            cells.add(f"{prefix}/{method}", failed=str(error), seconds=time.process_time() - start)
            continue
        seconds = time.process_time() - start
        cells.add(f"{prefix}/{method}", estimates=_kept(estimates[method]), draws=_draws(estimates[method]), seconds=seconds)
        told(f"{prefix} {method}: {seconds:.0f} s")
    if cells.get(f"{prefix}/choice") is None:
        start = time.process_time()
        choice = choose_default(buffer, {m: e for m, e in quick_estimators(seed).items() if m not in run.skip}, seed=seed)
        cells.add(f"{prefix}/choice", method=choice.method, reasons=[r.to_json() for r in choice.reasons],
                  table=[s.to_json() for s in choice.table],
                  seconds=time.process_time() - start)  # fmt: skip
    tables = {m: estimates.get(m) or _restored(m, cells.get(f"{prefix}/{m}")) for m in panel}
    bias = {s["method"]: s["bias"] for s in cells.get(f"{prefix}/choice")["table"]}
    parts = {m: t for m, t in tables.items() if t and m in bias}
    if parts and cells.get(f"{prefix}/{AGGREGATE}") is None:
        combined = combine(parts, bias)
        cells.add(f"{prefix}/{AGGREGATE}", estimates=_kept(combined), draws={}, seconds=0.0,
                  weights=next(iter(combined.values())).details["weights"])  # fmt: skip


def told(text: str) -> None:
    """Progress, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _kept(estimates: dict[str, Estimate]) -> dict[str, dict[str, Any]]:
    return {name: {k: getattr(e, k) for k in KEPT} for name, e in estimates.items()}


def _draws(estimates: dict[str, Estimate]) -> dict[str, list[float]]:
    return {name: [round(d, 3) for d in e.details.get("draws") or []] for name, e in estimates.items()}


def _restored(method: str, cell: dict[str, Any] | None) -> dict[str, Estimate] | None:
    if cell is None or "failed" in cell:
        return None
    return {
        name: Estimate(method=method, level=0.9, predicted={}, flags=(), n=0, details={"draws": cell["draws"].get(name, [])}, **kept)
        for name, kept in cell["estimates"].items()
    }


def summary(names: list[str], cells: Cells, sessions: int) -> dict[str, dict[str, dict[str, list[float]]]]:
    """world -> method -> metric -> one number per seed; `sessions` simulated ones are behind each true return.

    Three rows are no methods: `ranking` is the one that was chosen by held-out skill, its intervals widened as the service widens them;
    `days alone` is what a perfect method would say that knew everything about the days of the data and nothing about others; `tested` is
    what testing the policies themselves would tell, each in its share of as many sessions as the data hold, each on a day of its own.
    """
    result: dict[str, dict[str, dict[str, list[float]]]] = {}
    for name in names:
        for cell in cells.all(f"{name}/"):
            _, seed, method = cell["key"].split("/")
            if not seed.isdigit() or "failed" in cell:
                continue
            truth = cells.get(f"{name}/{seed}/truth")
            if method == "truth":
                rows = {"days alone": _days_alone(truth)} if truth["on_days"] else {}
                for metric, value in _tested(truth, sessions).items():
                    result.setdefault(name, {}).setdefault("tested", {}).setdefault(metric, []).append(value)
            elif method == "choice":
                rows = {"ranking": _widened(cells.get(f"{name}/{seed}/{cell['method']}"), cell)}
            else:
                rows = {method: cell["estimates"]}
            for row, estimates in rows.items():
                if estimates:
                    into = result.setdefault(name, {}).setdefault(row, {})
                    for metric, value in scores(truth, estimates).items():
                        into.setdefault(metric, []).append(value)
                    into.setdefault("seconds", []).append(float(cell.get("seconds", 0.0)))
    return result


def scores(truth: dict[str, Any], estimates: dict[str, dict[str, Any]]) -> dict[str, float]:
    """The metrics of one method on one data set."""
    names = list(truth["policies"])
    v = np.array([truth["policies"][p]["total"] for p in names])
    found = [estimates[p] for p in names]
    said = np.array([e["value"] for e in found])
    a, spread = accuracy(v, said), float(np.ptp(v))
    on_days = np.array([truth["on_days"][p]["total"] for p in names]) if truth["on_days"] else v
    inside = [e["low"] <= t <= e["high"] for e, t in zip(found, v, strict=True)]
    return {
        "rank correlation": a.rank_correlation if a.rank_correlation is not None else 0.0,
        "p": a.rank_p if a.rank_p is not None else 1.0,
        "regret, paper": a.regret_as_paper or 0.0,
        "regret, % of range": 100 * (a.regret_of_range or 0.0),
        "MAE, % of range": 100 * (a.mae_of_range or 0.0),
        "its days' MAE, %": 100 * float(np.abs(said - on_days).mean()) / spread,
        "differences' MAE, %": 100 * float(np.abs((said - said.mean()) - (v - v.mean())).mean()) / spread,
        "covered, %": 100 * float(np.mean(inside)),
    }


def _days_alone(truth: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {n: {"value": t["total"], "low": t["total"], "high": t["total"]} for n, t in truth["on_days"].items()}


def _tested(truth: dict[str, Any], sessions: int, draws: int = 200) -> dict[str, float]:
    """Metrics, averaged over draws, of the means of n / P sessions of each policy; the truth's error tells how sessions scatter."""
    rng, policies = np.random.default_rng(0), truth["policies"]
    each = truth["sessions"] / len(policies)
    found = []
    for _ in range(draws):
        drawn = {}
        for name, t in policies.items():
            error = t["standard_error"] * np.sqrt(sessions / each)
            value = t["total"] + error * rng.standard_normal()
            drawn[name] = {"value": value, "low": value - reach_with(0.0, error), "high": value + reach_with(0.0, error)}
        found.append(scores(truth, drawn) | {"seconds": 0.0})
    return {metric: float(np.mean([f[metric] for f in found])) for metric in found[0]}


def _widened(chosen: dict[str, Any] | None, choice: dict[str, Any]) -> dict[str, dict[str, Any]] | None:
    if chosen is None or "failed" in chosen:
        return None
    error = next((s["excess"] for s in choice["table"] if s["method"] == choice["method"]), 0.0)

    def wide(e: dict[str, Any]) -> dict[str, Any]:
        below, above = (reach_with(abs(e["value"] - e[end]), error) for end in ("low", "high"))
        return e | {"low": e["value"] - below, "high": e["value"] + above}

    return {n: wide(e) for n, e in chosen["estimates"].items()}


def show(found: dict[str, dict[str, dict[str, list[float]]]], cells: Cells) -> None:
    """Tables of means over seeds."""
    out = sys.stdout.write
    for name, methods in found.items():
        truth = cells.all(f"{name}/")
        first = next(c for c in truth if c["key"].endswith("/truth"))
        error = np.mean([p["standard_error"] for p in first["policies"].values()])
        spread = np.ptp([p["total"] for p in first["policies"].values()])
        seeds = max(len(row["p"]) for row in methods.values())
        out(f"\n{name}: {first['sessions']} sessions, {len(first['policies'])} policies, {seeds} seeds; ")
        out(f"true returns span {spread:.0f}, standard error {100 * error / spread:.1f} % of that\n")
        metrics = list(next(iter(methods.values())))
        out(f"{'':<11}" + "".join(f"{m:>21}" for m in metrics) + "\n")
        for method, row in sorted(methods.items(), key=lambda item: -float(np.mean(item[1]["rank correlation"]))):
            out(f"{method:<11}" + "".join(f"{np.mean(row[m]):>21.2f}" for m in metrics) + "\n")
        for cell in (c for c in truth if c["key"].endswith("/choice")):
            out(f"chosen by held-out skill, seed {cell['key'].split('/')[1]}: {cell['method']} ({cell['reason']})\n")
    if not found:
        out("no cell yet\n")


def show_targets(found: dict[str, dict[str, dict[str, list[float]]]]) -> None:
    """How far the ranking's estimates on the cohort are from what was aimed at, and by how much each aim is missed."""
    tables = {world: found[world] for world in PARTICIPANT_WORLDS if world in found and "ranking" in found[world]}
    if not tables:
        return

    def mean(method: str, metric: str) -> float:
        return float(np.mean([np.mean(t[method][metric]) for t in tables.values() if method in t]))

    least = min(float(np.mean(t["ranking"]["rank correlation"])) for t in tables.values())
    covered = mean("ranking", "covered, %")
    aims = [
        ("mean rank correlation", mean("ranking", "rank correlation"), 0.93, 1),
        ("least rank correlation of a participant", least, 0.85, 1),
        ("regret@1, % of range", mean("ranking", "regret, % of range"), 2.0, -1),
        ("mean error, % of range", mean("ranking", "MAE, % of range"), 8.0, -1),
        ("truths inside the intervals, %, at least", covered, 80.0, 1),
        ("truths inside the intervals, %, at most", covered, 97.0, -1),
    ]
    others = [m for m in ("wis", "pdis", "cwpdis", "dual_dice", "dlmm", "fqe") if all(m in t for t in tables.values())]
    if others and all("dlsm" in t for t in tables.values()):
        for metric, sign in (("rank correlation", 1), ("regret, % of range", -1)):
            best = max(sign * mean(m, metric) for m in others) * sign
            aims.append((f"dlsm: {metric}, against the best of {', '.join(others)}", mean("dlsm", metric), best, sign))
    told("\nAims on the cohort (means over participants):")
    for name, value, aim, sign in aims:
        short = sign * (aim - value)
        told(f"  {name:<86}{value:>8.2f}   aim {aim:>6.2f}   {'met' if short <= 0 else f'missed by {short:.2f}'}")
    if all("dlsm" in t and "linear" in t for t in tables.values()):
        pairs = [
            (a, b) for t in tables.values() for a, b in zip(t["dlsm"]["rank correlation"], t["linear"]["rank correlation"], strict=True)
        ]
        lead = np.array([a - b for a, b in pairs])
        error = float(lead.std(ddof=1) / np.sqrt(lead.size)) if lead.size > 1 else float("inf")
        verdict = "met" if lead.mean() >= -error else f"missed by {-lead.mean() - error:.2f}"
        told(f"  dlsm less linear, rank correlation: {lead.mean():.2f} +- {error:.2f}; not worse within one standard error: {verdict}")


def main() -> None:
    """Print a table per world and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one world, one seed, four policies, quick settings")
    parser.add_argument("--simulator", default="cohort", help="cohort, other, or the names of worlds with commas")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--without", default="", help="methods to leave out, with commas")
    parser.add_argument("--truth", type=int, help="simulated sessions behind each true return; 300 by default, 100 with --quick")
    parser.add_argument("--only-truth", action="store_true", help="train the policies, measure their true returns, and no more")
    parser.add_argument("--minutes", type=float, default=1e9, help="start no further world and seed after so many minutes")
    parser.add_argument("--out", type=Path, help="folder of cells.jsonl and ope.svg; a temporary one by default")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-ope-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / ("cells-quick.jsonl" if chosen.quick else "cells.jsonl"))
    named = {"cohort": list(PARTICIPANT_WORLDS), "other": list(OTHER_WORLDS)}
    names = named.get(chosen.simulator, chosen.simulator.split(","))
    names = names[:1] if chosen.quick else names
    sessions = chosen.truth or (100 if chosen.quick else 300)
    start = time.monotonic()
    run = Run(cells, out, chosen.quick, frozenset(chosen.without.split(",")), sessions)
    for seed in range(1 if chosen.quick else chosen.seeds):
        for name in names:
            if time.monotonic() - start < 60 * chosen.minutes:
                (prepare if chosen.only_truth else measure)(WORLDS[name](), seed, VISITS[name], run)
    found = summary(names, cells, sessions)
    show(found, cells)
    show_targets(found)
    figure = out / "ope.svg"
    figure.write_text(draw(found, ("rank correlation", "regret, % of range", "MAE, % of range")))
    sys.stdout.write(f"\nfigure: {figure}\n")
    figures = {f"{n}/{m}/{k}": float(np.mean(v)) for n, t in found.items() for m, row in t.items() for k, v in row.items()}
    sys.stdout.write(json.dumps({"name": "ope", "figures": figures, "ratios": {}, "baseline": "true returns by Monte Carlo"}) + "\n")


if __name__ == "__main__":
    main()
