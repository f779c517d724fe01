"""The DLSM's settings compared by held-out free-running prediction on several data sets; then, with --truth, against known returns.

    python -m benchmarks.development.dlsm_selection --quick
    python -m benchmarks.development.dlsm_selection --out FOLDER [--data hidden,P1] [--candidates sum,posterior] [--minutes 30]
    python -m benchmarks.development.dlsm_selection --out FOLDER --truth

The first table holds shares of a constant's error (`ml/ope/dlsm/held_out.py: Shares`); it is what a default is chosen by. Known returns are
computed only with --truth, in a second table, for what has been chosen. Finished cells are lines of FOLDER/selection.jsonl; a run that is
started again skips them. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.support.cells import Cells
from benchmarks.support.simulators import STEPS, VISITS, WORLDS
from ml.ope.compare.metrics import accuracy
from ml.ope.dlsm.batches import make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.estimator import Dlsm
from ml.ope.dlsm.selection import SelectionRun
from ml.ope.scale import learn_scale
from ml.policies.policy import ConstantPolicy, Policy, ProportionalPolicy
from ml.trajectories import ReplayBuffer

BASE = DlsmConfig(latent=8, hidden=24, heads=(24,), objective="sum", steps=150, learning_rate=6e-3)
LONG = {"steps": 400, "learning_rate": 3e-3, "check_every": 25}
SMALL = {"latent": 4, "hidden": 8, "heads": (8,)}
LARGE = {"latent": 16, "hidden": 64, "heads": (64,)}
CANDIDATES: dict[str, DlsmConfig] = {
    objective + label: replace(BASE, objective=objective, **changes)
    for label, changes in {
        "": {},
        ", short": {"steps": 75},
        ", long": LONG,
        ", small": SMALL,
        ", small, long": SMALL | LONG,
        ", large": LARGE,
        ", decay": {"weight_decay": 0.1},
    }.items()
    for objective in ("sum", "posterior", "free_running")
}
OBJECTIVES = ("posterior", "free_running", "sum")
DATA = ("linear", "hidden", "saturating", "switching", "P1", "P2", "P3", "P4")
TRUTH_SESSIONS = 100
PARTS = ("beta", "head", "known", "outcomes", "contrast")


def small_simulators() -> Any:
    """The two simulators of the tests."""
    path = Path(__file__).parents[2] / "tests" / "ml" / "ope" / "conftest.py"
    spec = importlib.util.spec_from_file_location("ope_test_simulators", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is not there")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Simulator


def buffer_of(name: str, seed: int) -> ReplayBuffer:
    """Sessions of a data set; one seed other than 0 is other sessions."""
    if name in ("linear", "hidden"):
        return small_simulators()(name).buffer(seed=seed)
    return WORLDS[name]().data(seed, VISITS[name])


def compare(name: str, candidate: str, seed: int, cells: Cells) -> None:
    """Held-out shares of one candidate on one data set."""
    key = f"{name}/{seed}/{candidate}"
    if cells.get(key):
        return
    buffer = buffer_of(name, seed)
    scale = learn_scale(buffer)
    start = time.process_time()
    found = SelectionRun(buffer, make_batch(buffer, scale), scale, [CANDIDATES[candidate]], seed, "").run()
    ways = [{part: getattr(s, part) for part in PARTS} | {"score": s.score} for s in found.shares[0]]
    cells.add(key, score=found.scores[0], ways=ways, seconds=time.process_time() - start)
    sys.stdout.write(f"{key}: {found.scores[0]:.3f}, {time.process_time() - start:.0f} s\n")
    sys.stdout.flush()


def show(names: list[str], candidates: list[str], seeds: int, cells: Cells) -> dict[str, float]:
    """Scores, their mean over data sets, and the parts averaged over data sets and ways of leaving out."""
    out = sys.stdout.write
    out("held-out score (1 is a constant, lower is better)\n")
    out(
        f"{'':<22}"
        + "".join(f"{n:>11}" for n in names)
        + f"{'mean':>9}{'rank':>7}"
        + "".join(f"{p:>10}" for p in PARTS)
        + f"{'CPU s':>8}\n"
    )
    table: dict[str, list[float]] = {}
    for candidate in candidates:
        row = [[c for s in range(seeds) if (c := cells.get(f"{name}/{s}/{candidate}"))] for name in names]
        if all(row):
            table[candidate] = [float(np.mean([c["score"] for c in group])) for group in row]
    ranks = np.argsort(np.argsort(np.array(list(table.values())), axis=0), axis=0).mean(1) + 1 if table else []
    for (candidate, scores), rank in zip(table.items(), ranks, strict=True):
        done = [c for name in names for s in range(seeds) if (c := cells.get(f"{name}/{s}/{candidate}"))]
        parts = [np.mean([w[p] for c in done for w in c["ways"] if w[p] is not None]) for p in PARTS]
        out(f"{candidate:<22}" + "".join(f"{v:>11.3f}" for v in scores) + f"{np.mean(scores):>9.3f}{rank:>7.2f}")
        out("".join(f"{p:>10.3f}" for p in parts) + f"{np.mean([c['seconds'] for c in done]):>8.0f}\n")
    return {f"{c}/{n}": v for c, row in table.items() for n, v in zip(names, row, strict=True)}


def show_choice(names: list[str], candidates: list[str], seeds: int, cells: Cells) -> dict[str, float]:
    """What a choice per data set is worth: chosen by one way of leaving out, scored by the other, beside each candidate for all."""
    keys = [f"{name}/{s}" for name in names for s in range(seeds)]
    found = [[cells.get(f"{key}/{c}") for c in candidates] for key in keys]
    both = np.array([[[w["score"] for w in c["ways"]] for c in row] for row in found if all(row) and all(len(c["ways"]) == 2 for c in row)])
    if not len(both):
        return {}
    crossed = np.mean([both[np.arange(len(both)), both[:, :, way].argmin(1), 1 - way] for way in (0, 1)])
    fixed = {c: float(v) for c, v in zip(candidates, both.mean((0, 2)), strict=True)}
    worst = {c: float(v) for c, v in zip(candidates, both.mean(2).max(0), strict=True)}
    sys.stdout.write(f"\n{len(both)} data sets; mean (worst) score of one choice for all: ")
    sys.stdout.write(", ".join(f"{c} {v:.3f} ({worst[c]:.2f})" for c, v in fixed.items()))
    sys.stdout.write(f"; chosen per data set by one way of leaving out and scored by the other: {crossed:.3f}\n")
    return {f"fixed/{c}": v for c, v in fixed.items()} | {"chosen per data set": float(crossed)}


def policies(xi: float) -> dict[str, Policy]:
    """Policies of varying quality, none of which made the data."""
    return {
        **{f"constant {c}": ConstantPolicy(c) for c in (0.4, 0.6, 0.8)},
        "eager": ProportionalPolicy(0.5 * xi, 0.9 * xi, 0.4, 2),
        "middle": ProportionalPolicy(0.8 * xi, 1.2 * xi, 0.3, 1),
        "slow": ProportionalPolicy(0.9 * xi, 1.2 * xi, 0.45, 10),
        "late": ProportionalPolicy(xi, 1.5 * xi, 0.1, 1),
        "lazy": ProportionalPolicy(1.1 * xi, 1.8 * xi, 0.3, 3),
    }


def truth_of(name: str, buffer: ReplayBuffer, cells: Cells) -> tuple[dict[str, Policy], dict[str, float]]:
    """Policies that did not make the data, and their true returns by Monte Carlo."""
    if name in ("linear", "hidden"):
        simulator = small_simulators()(name)
        return simulator.policies(), {p: sum(v) for p, v in simulator.truth(STEPS, 1000).items()}
    world, chosen = WORLDS[name](), policies(buffer.settings.xi_beta)
    cell = cells.get(f"truth/{name}")
    if cell is None:
        found = {p: world.truth(policy, TRUTH_SESSIONS) for p, policy in chosen.items()}
        error = float(np.mean([t.standard_error for t in found.values()]))
        cell = cells.add(f"truth/{name}", returns={p: t.total for p, t in found.items()}, standard_error=error)
    return chosen, cell["returns"]


def against_truth(name: str, candidate: str, seed: int, cells: Cells) -> None:
    """One candidate's ensemble against known returns."""
    key = f"measured/{name}/{seed}/{candidate}"
    if cells.get(key):
        return
    buffer = buffer_of(name, seed)
    chosen, returns = truth_of(name, buffer, cells)
    start = time.process_time()
    estimates = Dlsm(replace(CANDIDATES[candidate], seed=seed, members=3, rollouts=128)).fit(buffer).evaluate(chosen, STEPS)
    seconds = time.process_time() - start
    names = list(returns)
    values = [returns[p] for p in names]
    found: dict[str, Any] = {}
    sources: dict[str, Callable[[str], float]] = {
        "": lambda p: estimates[p].value,
        "head": lambda p: estimates[p].details["step_return_head"] + (estimates[p].end_reward or 0.0),
        "known": lambda p: estimates[p].details["step_return_known"] + (estimates[p].end_reward or 0.0),
    }
    for source, value in sources.items():
        a = accuracy(values, [value(p) for p in names])
        found[source] = [a.rank_correlation, a.regret_of_range, a.mae_of_range]
    inside = float(np.mean([estimates[p].low <= returns[p] <= estimates[p].high for p in names]))
    cells.add(key, found=found, inside=inside, seconds=seconds, source=estimates[names[0]].details["reward_source"])
    sys.stdout.write(f"{key}: {found}, {seconds:.0f} s\n")
    sys.stdout.flush()


def show_truth(names: list[str], candidates: list[str], seeds: int, cells: Cells) -> dict[str, float]:
    """Rank correlation / regret@1 / MAE (of the range), by data set and on average."""
    out = sys.stdout.write
    if not any(cells.get(f"measured/{n}/{s}/{c}") for n in names for s in range(seeds) for c in candidates):
        return {}
    out("\nmeasured afterwards: rank correlation / regret@1 / MAE, the latter two in % of the range of true returns\n")
    figures: dict[str, float] = {}
    for candidate in candidates:
        out(f"{candidate:<22}")
        for name in names:
            done = [c for s in range(seeds) if (c := cells.get(f"measured/{name}/{s}/{candidate}"))]
            if done:
                rho, regret, mae = np.mean([c["found"][""] for c in done], axis=0)
                figures |= {f"{candidate}/{name}/{k}": float(v) for k, v in (("rank", rho), ("regret", regret), ("mae", mae))}
                out(f" {name} {rho:.2f}/{100 * regret:.0f}/{100 * mae:.0f}")
        out("\n")
    return figures


def main() -> None:
    """Print the tables and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one data set, two candidates of 30 steps")
    parser.add_argument("--data", default=",".join(DATA))
    parser.add_argument("--candidates", default="|".join(CANDIDATES), help="names with | between them")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--truth", action="store_true", help="measure against known returns what the first table compared")
    parser.add_argument("--minutes", type=float, default=1e9, help="start no further cell after so many minutes")
    parser.add_argument("--out", type=Path, help="folder of selection.jsonl; a temporary one by default")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    names, candidates = chosen.data.split(","), chosen.candidates.split("|")
    if chosen.quick:
        CANDIDATES.update({c: replace(CANDIDATES[c], steps=30, check_every=15, members=1, rollouts=32) for c in ("sum", "posterior")})
        names, candidates = ["linear"], ["sum", "posterior"]
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-dlsm-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / "selection.jsonl")
    start = time.monotonic()
    for seed in range(chosen.seeds):
        for name in names:
            for candidate in candidates:
                if time.monotonic() - start < 60 * chosen.minutes:
                    (against_truth if chosen.truth else compare)(name, candidate, seed, cells)
    figures = show(names, candidates, chosen.seeds, cells) | show_choice(names, candidates, chosen.seeds, cells)
    figures |= show_truth(names, candidates, chosen.seeds, cells)
    sys.stdout.write(
        json.dumps({"name": "dlsm_selection", "figures": figures, "ratios": {}, "baseline": "mean of the learnt sessions"}) + "\n"
    )


if __name__ == "__main__":
    main()
