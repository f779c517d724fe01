"""What three visits teach: six policies by the default sweep on virtual patients, the posterior's first of them, and the best by truth.

    python -m benchmarks.development.learned --worlds 12 --out FOLDER             every fifth world of part A; resumable
    python -m benchmarks.development.learned --memory                             critics that see past amplitudes, and those that do not
    python -m benchmarks.development.learned --quick                              one world, few updates and simulated sessions
    python -m benchmarks.development.learned --designs stratified,paper           data by both designs
    python -m benchmarks.development.learned --part B                             to report on; each run is counted

A policy succeeds where all three QoCs are truly within the default margins of cDBS and it saves a fifth of the energy. Told over
responders, patients in whom some constant or proportional controller does: the share in which the policy that the posterior puts first
succeeds, and in which any of the six does; energy and true gain of both. Training is the service's: learning rates, left-out sessions and
the choice of a state are those of a sweep of the preset `quick`. True returns only measure. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from app.learning.schemas import DEFAULT_SWEEP, TrainParams
from app.learning.training.compute import hold_out
from app.learning.training.configs import training_groups
from benchmarks.support.cells import Cells
from benchmarks.support.looks import look
from ml import rl
from ml.ope.posterior.gains import gains_over_cdbs
from ml.policies.policy import ConstantPolicy, Policy
from ml.population.virtual import DataDesign, World, is_responder, simple_policies, within_margins, world
from ml.trajectories import ReplayBuffer

POLICIES, TRUTH, EVERY, SAVED = 6, 150, 5, 0.2
QUICK_UPDATES, QUICK_TRUTH = 50, 40
DESIGNS: tuple[DataDesign, ...] = ("stratified", "paper")


def sweep(buffer: ReplayBuffer, memory: bool, updates: int | None) -> dict[str, Policy]:
    """Six policies as a sweep of the service trains them."""
    found: dict[str, Policy] = {}
    for group in training_groups(TrainParams(preset="quick", count=POLICIES, updates=updates, **DEFAULT_SWEEP), [None] * POLICIES):
        given = [{**config, "critic_memory": memory} for config in group["configs"]]
        configs = [rl.algorithm(group["algorithm"]).config.from_json(one) for one in given]
        learnt, held = hold_out(buffer, wanted=True, every=max(1, configs[0].updates // 10))
        for config, result in zip(configs, rl.train_many(learnt, configs, held_out=held), strict=True):
            held_near = "cDBS" if getattr(config, "anchor", "") == "constant" else "logged"
            found[f"{group['algorithm']} {config.aim} {held_near} {config.seed}"] = result.policy
    return found


def cell(w: World, design: DataDesign, memory: bool, quick: bool) -> dict[str, Any]:
    """What the six of one virtual patient are, by the posterior and by truth."""
    buffer = w.data(design)
    policies, truth = sweep(buffer, memory, QUICK_UPDATES if quick else None), QUICK_TRUTH if quick else TRUTH
    gains = gains_over_cdbs(buffer, policies)
    cdbs = w.truth(ConstantPolicy(1.0), truth)
    simple = {name: w.truth(policy, truth) for name, policy in simple_policies(w.settings, w.spread).items()}
    rows = {}
    for name, policy in policies.items():
        true = w.truth(policy, truth)
        saves = 1 - true.energy.value / cdbs.energy.value
        rows[name] = {
            "posterior": gains[name].gain.value,
            "supported": gains[name].supported,
            "told": gains[name].told,
            "gain": true.total.value - cdbs.total.value,
            "saves": saves,
            "succeeds": bool(saves >= SAVED and within_margins(true, cdbs)),
        }
    return {"responder": is_responder(simple, cdbs), "policies": rows}


def first_by_posterior(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The row with the largest estimated gain, of those that sessions support where any is."""
    supported = [row for row in rows.values() if row["supported"]]
    return max(supported or rows.values(), key=lambda row: float(row["posterior"]))


def told(cells: list[dict[str, Any]]) -> dict[str, float]:
    """Shares and means over responders."""
    rows = [one["policies"] for one in cells if one["responder"]]
    first = [first_by_posterior(of) for of in rows]
    best = [max(of.values(), key=lambda row: float(row["gain"])) for of in rows]
    return {
        "responders": float(len(rows)),
        "first_succeeds": float(np.mean([row["succeeds"] for row in first])),
        "any_succeeds": float(np.mean([any(row["succeeds"] for row in of.values()) for of in rows])),
        "first_gain": float(np.mean([row["gain"] for row in first])),
        "best_gain": float(np.mean([row["gain"] for row in best])),
        "mean_gain": float(np.mean([row["gain"] for of in rows for row in of.values()])),
        "first_saves": float(np.mean([row["saves"] for row in first])),
        "seconds": float(np.mean([one["seconds"] for one in cells])),
    }


def main() -> None:
    """Print a line per arm and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"one world, {QUICK_UPDATES} updates, few simulated sessions")
    parser.add_argument("--part", default="A", choices=("A", "B"), help="A to develop on, B to report on")
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--every", type=int, default=EVERY, help="take every so manyth world")
    parser.add_argument("--designs", default="stratified", help="with commas: stratified, paper")
    parser.add_argument("--memory", action="store_true", help="critics that see past amplitudes, and those that do not")
    parser.add_argument("--out", type=Path, help="folder of the finished worlds; a temporary one by default")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    look(chosen.part, " ".join(["learned", *sys.argv[1:]]), None)
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-learned-"))
    out.mkdir(parents=True, exist_ok=True)
    cells, figures = Cells(out / f"learned{'-quick' if chosen.quick else ''}.jsonl"), {}
    arms = [
        (d, m)
        for d in DESIGNS
        if d in chosen.designs.split(",")
        for m in ((False, True) if chosen.memory else (DEFAULT_SWEEP["critic_memory"],))
    ]
    for index in range(0, chosen.every * (1 if chosen.quick else chosen.worlds), chosen.every):
        for design, memory in arms:
            key = f"{chosen.part} {design} {'memory' if memory else 'window'}"
            if cells.get(f"{key} {index:02d}") is None:
                start = time.process_time()
                found = cell(world(chosen.part, index), design, memory, chosen.quick)
                cells.add(f"{key} {index:02d}", **found, seconds=time.process_time() - start)
                print(f"{key} {index:02d}: {time.process_time() - start:.0f} s", flush=True)
    for design, memory in arms:
        key = f"{chosen.part} {design} {'memory' if memory else 'window'}"
        figures[key] = told(cells.all(f"{key} "))
        print(key, " ".join(f"{name} {value:.2f}" for name, value in figures[key].items()))
    print(json.dumps({"name": "learned", "figures": figures}))


if __name__ == "__main__":
    main()
