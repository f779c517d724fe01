"""Policies that three visits teach: six by the default sweep on virtual patients, the posterior's first of them, and the best by truth.

    python -m benchmarks.evaluation.learned --worlds 12 --out FOLDER             every fifth world of part A; resumable
    python -m benchmarks.evaluation.learned --updates 2000 --minutes 20          shorter trainings; no further world after so long
    python -m benchmarks.evaluation.learned --untrained --every 4 --worlds 15    the dose alone that the anchor `best` holds a policy near
    python -m benchmarks.evaluation.learned --quick                              one world, few updates and simulated sessions
    python -m benchmarks.evaluation.learned --designs stratified,paper           data by both designs
    python -m benchmarks.evaluation.learned --part B                             to report on; each run is counted

A policy succeeds where all three QoCs are truly within the default margins of cDBS and it saves a fifth of the energy. Reported over
responders, patients in whom some constant or proportional controller does, and others are not trained: the share in which the policy that
the posterior puts first succeeds, and in which any of the six does; energy and true gain of both; between arms the difference of the same
patients with its standard error. First is as in the ranking: what no session supports, or what probably leaves the margins, comes last.
`first_by_saving` is the one with the largest saving times the probability of keeping the margins instead of the largest return. Training is
the service's: learning rates, left-out sessions and the choice of a state are those of a sweep of the preset `quick`. True returns only
measure. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from app.learning.schemas import DEFAULT_SWEEP, TrainParams
from app.learning.sweeps import held_near
from app.learning.training_compute import hold_out, supported_best, with_best_anchor
from app.learning.training_configs import training_groups
from benchmarks.support.cells import Cells
from benchmarks.support.looks import look, said
from benchmarks.support.results import run_benchmark
from ml import rl
from ml.ope.posterior.gains import PosteriorGain, gains_over_cdbs
from ml.ope.posterior.verdict import Levels
from ml.policies.policy import ConstantPolicy, Policy
from ml.population.virtual import DataDesign, World, is_responder, simple_policies, within_margins, world
from ml.trajectories import ReplayBuffer

POLICIES, TRUTH, EVERY, SAVED = 6, 150, 5, 0.2
QUICK_UPDATES, QUICK_TRUTH = 50, 40
DESIGNS: tuple[DataDesign, ...] = ("stratified", "paper")


class Arm(NamedTuple):
    """Way in which data are made and policies trained; without `trained`, the dose alone that they would be kept near."""

    design: DataDesign
    trained: bool = True

    @property
    def key(self) -> str:
        """Its name in files and lines."""
        return self.design if self.trained else f"{self.design} untrained"


def sweep(buffer: ReplayBuffer, updates: int | None) -> dict[str, Policy]:
    """Train six policies as a sweep of the service does."""
    found: dict[str, Policy] = {}
    for group in training_groups(TrainParams(preset="quick", count=POLICIES, updates=updates, **DEFAULT_SWEEP), [None] * POLICIES):
        given = with_best_anchor(group["configs"], buffer, margins=None)
        configs = [rl.algorithm(group["algorithm"]).config.from_json(one) for one in given]
        learnt, held = hold_out(buffer, wanted=True, every=max(1, configs[0].updates // 10))
        for config, result in zip(configs, rl.train_many(learnt, configs, held_out=held), strict=True):
            found[f"{group['algorithm']} {config.aim}, near {held_near(config.to_json()) or 'nothing'}, {config.seed}"] = result.policy
    return found


def anchor_alone(buffer: ReplayBuffer) -> dict[str, Policy]:
    """Return the dose that the anchor `best` keeps a policy near, as a policy."""
    best = supported_best(buffer, margins=None)
    return {"anchor": ConstantPolicy(1.0 if best is None else best)}


def cell(w: World, arm: Arm, updates: int | None, truth: int) -> dict[str, Any]:
    """Measure the six of one virtual patient, by the posterior and by truth; none are trained for patients who respond to nothing
    simple."""
    cdbs = w.truth(ConstantPolicy(1.0), truth)
    if not is_responder({name: w.truth(policy, truth) for name, policy in simple_policies(w.settings, w.spread).items()}, cdbs):
        return {"responder": False, "policies": {}}
    buffer = w.data(arm.design)
    policies = sweep(buffer, updates) if arm.trained else anchor_alone(buffer)
    gains = gains_over_cdbs(buffer, policies)
    rows = {}
    for name, policy in policies.items():
        true = w.truth(policy, truth)
        saves = 1 - true.energy.value / cdbs.energy.value
        rows[name] = {
            "posterior": gains[name].gain.value,
            "supported": gains[name].supported,
            "within": gains[name].within,
            "told": gains[name].told,
            "expected_saving": expected_saving(gains[name]),
            "gain": true.total.value - cdbs.total.value,
            "saves": saves,
            "succeeds": bool(saves >= SAVED and within_margins(true, cdbs)),
        }
    return {"responder": True, "policies": rows}


def first_by(rows: dict[str, dict[str, Any]], column: str) -> dict[str, Any]:
    """Find the row with the largest value of a column, of those that the ranking does not put last where any is."""
    fit = [row for row in rows.values() if row["supported"] and 1 - row["within"] < Levels().unsafe_beyond]
    return max(fit or rows.values(), key=lambda row: float(row[column]))


def expected_saving(one: PosteriorGain) -> float:
    """Compute the energy that a policy is expected to save times its probability of keeping the margins, as the anchor `best` is found."""
    return (one.saves or 0.0) * (1.0 if one.within is None else one.within)


def outcomes(rows: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Compute one patient's figures."""
    first, saving = first_by(rows, "posterior"), first_by(rows, "expected_saving")
    best = max(rows.values(), key=lambda row: float(row["gain"]))
    return {
        "first_succeeds": float(first["succeeds"]),
        "first_by_saving_succeeds": float(saving["succeeds"]),
        "any_succeeds": float(any(row["succeeds"] for row in rows.values())),
        "succeed": float(np.mean([row["succeeds"] for row in rows.values()])),
        "first_gain": first["gain"],
        "best_gain": best["gain"],
        "mean_gain": float(np.mean([row["gain"] for row in rows.values()])),
        "first_saves": first["saves"],
        "first_by_saving_saves": saving["saves"],
    }


def told(cells: list[dict[str, Any]]) -> dict[str, float]:
    """Compute shares and means over responders."""
    each = [outcomes(one["policies"]) for one in cells if one["responder"]]
    means = {name: float(np.mean([one[name] for one in each])) for name in (each[0] if each else ())}
    return {"responders": float(len(each))} | means | {"seconds": float(np.mean([one["seconds"] for one in cells if one["responder"]]))}


def differences(cells: dict[str, dict[str, Any]], others: dict[str, dict[str, Any]]) -> dict[str, tuple[float, float]]:
    """Compute the mean and standard error of one arm less another over the responders of both, which are the same patients."""
    both = [(outcomes(cells[k]["policies"]), outcomes(others[k]["policies"])) for k in cells if k in others and cells[k]["responder"]]
    if len(both) < 2:
        return {}
    apart = {name: np.array([one[name] - other[name] for one, other in both]) for name in both[0][0]}
    return {name: (float(d.mean()), float(d.std(ddof=1) / np.sqrt(d.size))) for name, d in apart.items()}


def arms(chosen: argparse.Namespace) -> list[Arm]:
    """List the arms that the options name."""
    return [Arm(d, trained=not chosen.untrained) for d in DESIGNS if d in chosen.designs.split(",")]


def trained(chosen: argparse.Namespace, of: list[Arm]) -> dict[str, dict[str, dict[str, Any]]]:
    """Collect the finished worlds of every arm, by its key and the world's number."""
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-learned-"))
    out.mkdir(parents=True, exist_ok=True)
    updates, truth = (QUICK_UPDATES, QUICK_TRUTH) if chosen.quick else (chosen.updates, TRUTH)
    cells, begun = Cells(out / f"learned-{updates or 'preset'}.jsonl"), time.monotonic()
    found: dict[str, dict[str, dict[str, Any]]] = {arm.key: {} for arm in of}
    for index in range(0, chosen.every * (1 if chosen.quick else chosen.worlds), chosen.every):
        for arm in of:
            key = f"{chosen.part} {arm.key} {index:02d}"
            if cells.get(key) is None and time.monotonic() - begun < 60 * chosen.minutes:
                start = time.process_time()
                one = cell(world(chosen.part, index), arm, updates, truth)
                cells.add(key, **one, seconds=time.process_time() - start)
                sys.stdout.write(f"{key}: {time.process_time() - start:.0f} s\n")
                sys.stdout.flush()
            if (known := cells.get(key)) is not None:
                found[arm.key][f"{index:02d}"] = known
    return found


def main() -> None:
    """Print a line per arm and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"one world, {QUICK_UPDATES} updates, few simulated sessions")
    parser.add_argument("--part", default="A", choices=("A", "B"), help="A to develop on, B to report on")
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--every", type=int, default=EVERY, help="take every so manyth world")
    parser.add_argument("--designs", default="stratified", help="with commas: stratified, paper")
    parser.add_argument("--untrained", action="store_true", help="the dose alone that policies would be kept near")
    parser.add_argument("--updates", type=int, help="of every training; those of the preset by default")
    parser.add_argument("--minutes", type=float, default=1e9, help="start no further training after so many minutes")
    parser.add_argument("--out", type=Path, help="folder of the finished worlds; a temporary one by default")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    look(chosen.part, " ".join(["learned", *sys.argv[1:]]), None)
    sys.stdout.write(f"{said()}\n")
    of = arms(chosen)
    found, figures = trained(chosen, of), {}
    for arm in of:
        figures[arm.key] = told(list(found[arm.key].values()))
        sys.stdout.write(f"{arm.key}: {' '.join(f'{name} {value:.2f}' for name, value in figures[arm.key].items())}\n")
    for arm in of[1:]:
        apart = differences(found[arm.key], found[of[0].key])
        sys.stdout.write(f"{arm.key} less {of[0].key}: {' '.join(f'{n} {m:+.2f} +- {e:.2f}' for n, (m, e) in apart.items())}\n")
    sys.stdout.write(json.dumps({"name": "learned", "figures": figures}) + "\n")


if __name__ == "__main__":
    run_benchmark(main)
