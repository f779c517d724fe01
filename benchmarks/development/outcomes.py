"""How well end-of-session outcomes are predicted, dynamics apart: the outcome model is given true sessions of each policy.

    python -m benchmarks.development.outcomes                  every second world of part A, both designs
    python -m benchmarks.development.outcomes --participants   the four detailed participants: three visits, all visits of six data seeds
    python -m benchmarks.development.outcomes --pooled --out FOLDER   dose shapes pooled over cohorts of part A; resumable

A model that is fitted to the data sees beta and amplitudes of simulated sessions of the candidates on new days and predicts their mean
outcomes, which are known. Left-out visits are sessions of the data; beside them stand the mean of the other visits and that of the very
visit, which no method can know. Nothing is fitted or chosen by what is true. What `--pooled` measures stands in
`benchmarks/support/pooled_shapes.py`. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.support.cells import Cells
from benchmarks.support.ope_policies import fixed_policies
from benchmarks.support.pooled_shapes import COHORTS, cohorts_pooled
from benchmarks.support.simulators import VISITS
from benchmarks.support.simulators import WORLDS as SIMULATORS
from ml.mdp import MdpSettings
from ml.ope.compare.metrics import spearman
from ml.ope.outcomes.minutes import by_minute
from ml.ope.outcomes.model import fit_end_model
from ml.ope.scale import outcome_table
from ml.policies.policy import ConstantPolicy, Policy
from ml.population.truth import sample_sessions
from ml.population.virtual import WORLDS_PER_PART, world
from ml.population.virtual.sessions import new_days
from ml.trajectories import ReplayBuffer

CDBS = "cDBS"
FIRST = 5000
"""Number of the first simulated session of a world; none of the data or of other truths."""
NAMES = ("r_end", "grasp", "rating", "tremor")


@dataclass(frozen=True)
class Sessions:
    """Simulated sessions of a policy: beta and amplitude [n, T], QoCs [n, 3]."""

    beta: np.ndarray
    amplitude: np.ndarray
    qoc: np.ndarray


@dataclass(frozen=True)
class Case:
    """A patient: data by name, and true sessions of each policy."""

    name: str
    settings: MdpSettings
    data: Mapping[str, Callable[[], ReplayBuffer]]
    sessions: Mapping[str, Sessions]


def worlds(every: int, sessions: int) -> Iterator[Case]:
    for index in range(0, WORLDS_PER_PART, every):
        w = world("A", index)
        if w.settings.c2 == 0:
            continue
        days, policies = new_days(w.key, FIRST, sessions), {**w.candidates(), CDBS: ConstantPolicy(1.0)}
        runs = {n: w.run(p, days, FIRST) for n, p in policies.items()}
        kept = {n: Sessions(r.beta, r.amplitude, np.stack([r.grasp_hz, r.rating, r.tremor_percent], axis=1)) for n, r in runs.items()}
        yield Case(w.name, w.settings, {d: (lambda w=w, d=d: w.data(d)) for d in ("paper", "stratified")}, kept)


def participants(sessions: int) -> Iterator[Case]:
    for code in ("P1", "P2", "P3", "P4"):
        simulator = SIMULATORS[code]()
        policies: dict[str, Policy] = {**fixed_policies(simulator.settings.xi_beta), CDBS: ConstantPolicy(1.0)}
        kept = {}
        for name, policy in policies.items():
            lower = simulator.settings.lower_bound
            run = sample_sessions(policy, code, sessions=sessions, seed=77, steps=300, window=10, lower_bound=lower)
            qoc = np.array([[o.qoc.grasp_hz, o.qoc.rating, o.qoc.tremor_percent] for o in run.outcomes])
            kept[name] = Sessions(run.beta, run.amplitude, qoc)
        data = {"three visits": lambda s=simulator: s.data(0, 3), "six data sets": lambda s=simulator, c=code: many(s, VISITS[c])}
        yield Case(code, simulator.settings, data, kept)


def many(simulator: object, visits: int) -> ReplayBuffer:
    """Sessions of six data seeds as visits of one participant."""
    parts = [simulator.data(seed, visits) for seed in range(1, 7)]  # type: ignore[attr-defined]
    rows = [replace(s, visit=s.visit + 100 * k) for k, part in enumerate(parts) for s in part.sessions]
    return replace(parts[0], sessions=tuple(replace(s, session_id=i) for i, s in enumerate(rows)))


def constants(settings: MdpSettings) -> np.ndarray:
    """r_end = constants . (grasp, rating, tremor)."""
    return np.array([settings.c2, settings.c3, -settings.c4 / (100 if settings.tremor_as_fraction else 1)])


def against_truth(case: Case, buffer: ReplayBuffer) -> tuple[dict[str, float], np.ndarray]:
    """Figures over the candidates, and the error of r_end of every policy."""
    model = fit_end_model(buffer)
    found = {n: model.predict(by_minute(s.beta, s.amplitude, case.settings)).mean(0) for n, s in case.sessions.items()}
    true = np.array([s.qoc.mean(0) for s in case.sessions.values()])
    ends, said = true @ constants(case.settings), np.array([f[0] for f in found.values()])
    error = said - ends
    contrast = error[:-1] - error[-1]
    parts = np.sqrt(np.mean((np.array([f[1:] for f in found.values()]) - true) ** 2, axis=0))
    figures = {"rmse": float(np.sqrt(np.mean(error**2))), "of_range": float(np.abs(error).mean() / np.ptp(ends))}
    figures |= {"rmse_to_cdbs": float(np.sqrt(np.mean(contrast**2))), "bias": float(error.mean()), "rank": spearman(said, ends) or 0.0}
    return figures | dict(zip(NAMES[1:], parts.tolist(), strict=True)), error


def left_out_visits(buffer: ReplayBuffer) -> np.ndarray:
    """Root mean squared error of r_end of sessions of left-out visits: the model, the other visits' mean, the very visit's mean, [3]."""
    table, visits, squares = outcome_table(buffer), np.array([s.visit for s in buffer.sessions]), []
    for visit in np.unique(visits):
        rest = tuple(s for s in buffer.sessions if s.visit != visit)
        model = fit_end_model(replace(buffer, sessions=rest))
        left = [s for s in buffer.sessions if s.visit == visit]
        said = np.array([model.predict(by_minute(s.beta, s.amplitude, buffer.settings))[0] for s in left])
        y, others = table[visits == visit, 0], table[visits != visit, 0]
        squares.append(np.stack([said - y, np.nanmean(others) - y, np.nanmean(y) - y]) ** 2)
    return np.sqrt(np.nanmean(np.concatenate(squares, axis=1), axis=1))


def pooled(out: Path, cohorts: int, quick: bool) -> None:
    """What pooling dose shapes does in cohorts of virtual patients; finished ones are kept in a folder."""
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    found = cohorts_pooled(Cells(out / f"pooled{'-quick' if quick else ''}.jsonl"), cohorts, quick)
    sys.stdout.write(json.dumps({"name": "pooled_shapes", "figures": found, "ratios": {}, "baseline": "no pooling"}) + "\n")


def main() -> None:
    """Print tables and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--participants", action="store_true")
    parser.add_argument("--pooled", action="store_true", help="cohorts in which dose shapes are pooled, instead")
    parser.add_argument("--cohorts", type=int, default=COHORTS, help="with --pooled: cohorts of each kind")
    parser.add_argument("--out", type=Path, help="with --pooled: folder of finished cohorts; a temporary one by default")
    parser.add_argument("--every", type=int, default=2, help="every n-th world")
    parser.add_argument("--sessions", type=int, help="true sessions of each policy; 80, or 40 of participants")
    parser.add_argument("--quick", action="store_true", help="three worlds, or few true sessions of participants")
    chosen = parser.parse_args()
    if chosen.pooled:
        pooled(chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-pooled-")), chosen.cohorts, chosen.quick)
        return
    if chosen.quick:
        chosen.every, chosen.sessions = 20, chosen.sessions or 20
    cases = participants(chosen.sessions or 40) if chosen.participants else worlds(chosen.every, chosen.sessions or 80)
    rows: dict[str, list[dict[str, float]]] = {}
    for case in cases:
        for name, data in case.data.items():
            buffer, start = data(), time.process_time()
            figures, error = against_truth(case, buffer)
            figures["seconds"] = time.process_time() - start
            figures |= dict(zip(("left_out", "others_mean", "own_mean"), left_out_visits(buffer).tolist(), strict=True))
            rows.setdefault(name, []).append(figures)
            if chosen.participants:
                told = ", ".join(f"{n} {e:+.1f}" for n, e in zip(case.sessions, error, strict=True))
                sys.stdout.write(f"{case.name}, {name}: rmse {figures['rmse']:.1f} of {len(buffer.sessions)} sessions; {told}\n")
    summary = {}
    for name, found in rows.items():
        for key in found[0]:
            values = np.array([f[key] for f in found])
            summary[f"{key}_{name.replace(' ', '_')}"] = float(values.mean())
            error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
            sys.stdout.write(f"{name:<15}{key:<15}{values.mean():9.3f} +- {error:.3f}\n")
    sys.stdout.write(json.dumps({"name": "outcomes", "figures": summary, "ratios": {}, "baseline": None}) + "\n")


if __name__ == "__main__":
    main()
