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
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from figure import draw
from simulators import STEPS, WORLDS, World

from ml.ope.aggregate import METHOD as AGGREGATE
from ml.ope.aggregate import combine
from ml.ope.estimate import Estimate
from ml.ope.metrics import accuracy
from ml.ope.panel import estimators, quick_estimators
from ml.ope.skill import choose_default
from ml.rl.actor_critic import DdpgConfig, train
from ml.rl.distillation import DistilConfig, distil
from ml.rl.policy import ConstantPolicy, Policy, ProportionalPolicy
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


def policies(buffer: ReplayBuffer, seed: int, quick: bool) -> dict[str, Policy]:
    """Policies of varying quality, none of which made the data: constants, proportional, trained with different settings, distilled."""
    xi = buffer.settings.xi_beta
    simple: dict[str, Policy] = {
        "constant 0.40": ConstantPolicy(0.40),
        "constant 0.70": ConstantPolicy(0.70),
        "proportional fast": ProportionalPolicy(0.7 * xi, 1.2 * xi, 0.35, 2),
        "proportional late": ProportionalPolicy(xi, 1.5 * xi, 0.1, 1),
    }
    if quick:
        return simple
    short = DdpgConfig(hidden=(64, 48), updates=1500, actor_lr=1e-3, seed=seed)
    long = DdpgConfig(hidden=(64, 48), updates=4000, actor_lr=3e-4, seed=seed + 1)
    teacher = train(buffer, long).policy
    return simple | {
        "constant 0.85": ConstantPolicy(0.85),
        "trained briefly": train(buffer, short).policy,
        "trained longer": teacher,
        "distilled": distil(teacher, buffer, DistilConfig(updates=800, sigma=0.6, seed=seed)).policy,
    }


def measure(world: World, seed: int, visits: int, cells: Cells, quick: bool, skip: set[str], sessions: int) -> None:
    """All cells of one world and seed: truth, every method, the aggregate, and the choice by held-out skill."""
    prefix = f"{world.name}/{seed}"
    panel = {m: e for m, e in estimators(seed, demo=quick).items() if m not in skip}
    wanted = [f"{prefix}/{m}" for m in (*panel, AGGREGATE, "choice")]
    if all(cells.get(k) for k in wanted):
        return
    buffer = world.data(seed, visits)
    chosen = policies(buffer, seed, quick)
    truth = cells.get(f"{prefix}/truth")
    if truth is None:
        found = {name: asdict(world.truth(policy, sessions)) for name, policy in chosen.items()}
        truth = cells.add(f"{prefix}/truth", policies=found, sessions=len(buffer.sessions))
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
        cells.add(
            f"{prefix}/{method}", estimates=_kept(estimates[method]), draws=_draws(estimates[method]), seconds=time.process_time() - start
        )
        sys.stdout.write(f"{prefix} {method}: {time.process_time() - start:.0f} s\n")
        sys.stdout.flush()
    start = time.process_time()
    choice = choose_default(buffer, {m: e for m, e in quick_estimators(seed).items() if m not in skip}, seed=seed)
    cells.add(f"{prefix}/choice", method=choice.method, reason=choice.reason, table=[s.to_json() for s in choice.table],
              seconds=time.process_time() - start)  # fmt: skip
    tables = {m: estimates.get(m) or _restored(m, cells.get(f"{prefix}/{m}")) for m in panel}
    bias = {s.method: s.bias for s in choice.table}
    parts = {m: t for m, t in tables.items() if t and m in bias}
    if parts:
        combined = combine(parts, bias)
        cells.add(f"{prefix}/{AGGREGATE}", estimates=_kept(combined), draws={}, seconds=0.0,
                  weights=next(iter(combined.values())).details["weights"])  # fmt: skip


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


def summary(names: list[str], cells: Cells) -> dict[str, dict[str, dict[str, list[float]]]]:
    """world -> method -> metric -> one number per seed."""
    result: dict[str, dict[str, dict[str, list[float]]]] = {}
    for name in names:
        for cell in cells.all(f"{name}/"):
            _, seed, method = cell["key"].split("/")
            if method in ("truth", "choice") or "failed" in cell:
                continue
            truth = cells.get(f"{name}/{seed}/truth")["policies"]
            v = [truth[p]["total"] for p in truth]
            found = [cell["estimates"][p] for p in truth]
            a = accuracy(v, [e["value"] for e in found])
            inside = [e["low"] <= t <= e["high"] for e, t in zip(found, v, strict=True)]
            steps = accuracy([truth[p]["step_return"] for p in truth], [e["step_return"] for e in found])
            row = {
                "rank correlation": a.rank_correlation if a.rank_correlation is not None else 0.0,
                "p": a.rank_p if a.rank_p is not None else 1.0,
                "regret, paper": a.regret_as_paper or 0.0,
                "regret": a.regret,
                "regret, % of range": 100 * (a.regret_of_range or 0.0),
                "MAE, % of range": 100 * (a.mae_of_range or 0.0),
                "step MAE, % of range": 100 * (steps.mae_of_range or 0.0),
                "covered, %": 100 * float(np.mean(inside)),
                "seconds": cell["seconds"],
            }
            into = result.setdefault(name, {}).setdefault(method, {})
            for metric, value in row.items():
                into.setdefault(metric, []).append(float(value))
    return result


def show(found: dict[str, dict[str, dict[str, list[float]]]], cells: Cells) -> None:
    """Tables of means over seeds."""
    out = sys.stdout.write
    for name, methods in found.items():
        truth = cells.all(f"{name}/")
        first = next(c for c in truth if c["key"].endswith("/truth"))
        error = np.mean([p["standard_error"] for p in first["policies"].values()])
        spread = np.ptp([p["total"] for p in first["policies"].values()])
        seeds = len(next(iter(methods.values()))["p"])
        out(f"\n{name}: {first['sessions']} sessions, {len(first['policies'])} policies, {seeds} seeds; ")
        out(f"true returns span {spread:.0f}, standard error {100 * error / spread:.1f} % of that\n")
        metrics = list(next(iter(methods.values())))
        out(f"{'':<10}" + "".join(f"{m:>21}" for m in metrics) + "\n")
        for method, row in sorted(methods.items(), key=lambda item: -float(np.mean(item[1]["rank correlation"]))):
            out(f"{method:<10}" + "".join(f"{np.mean(row[m]):>21.2f}" for m in metrics) + "\n")
        for cell in (c for c in truth if c["key"].endswith("/choice")):
            out(f"chosen by held-out skill, seed {cell['key'].split('/')[1]}: {cell['method']} ({cell['reason']})\n")
    if not found:
        out("no cell yet\n")


def main() -> None:
    """Print a table per world and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one world, one seed, four policies, quick settings")
    parser.add_argument("--simulator", default="cohort", help="cohort, other, or the names of worlds with commas")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--without", default="", help="methods to leave out, with commas")
    parser.add_argument("--truth", type=int, help="simulated sessions behind each true return; 300 by default, 100 with --quick")
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
    for seed in range(1 if chosen.quick else chosen.seeds):
        for name in names:
            if time.monotonic() - start < 60 * chosen.minutes:
                measure(WORLDS[name](), seed, VISITS[name], cells, chosen.quick, set(chosen.without.split(",")), sessions)
    found = summary(names, cells)
    show(found, cells)
    figure = out / "ope.svg"
    figure.write_text(draw(found, ("rank correlation", "regret, % of range", "MAE, % of range")))
    sys.stdout.write(f"\nfigure: {figure}\n")
    figures = {f"{n}/{m}/{k}": float(np.mean(v)) for n, t in found.items() for m, row in t.items() for k, v in row.items()}
    sys.stdout.write(json.dumps({"name": "ope", "figures": figures, "ratios": {}, "baseline": "true returns by Monte Carlo"}) + "\n")


if __name__ == "__main__":
    main()
