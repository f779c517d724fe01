"""The virtual population: how fast it is simulated, what part A holds, and what each design of exploration buys per minute of visit.

    python benchmarks/population.py --quick              speed, and what part A holds in a tenth of its worlds
    python benchmarks/population.py --out FOLDER         speed, the whole part, designs on every tenth world; figure FOLDER/designs.svg
    python benchmarks/population.py --part B --every 6   the same of part B, designs on every sixth world; each run is counted

The designs are compared by what the linear model, which has no tuning, makes of their data: rank correlation with true returns over the
candidates, after one, two and three visits of the same minutes. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from support.figure import draw
from support.looks import look, said
from support.results import run_benchmark

from ml.ope.compare.metrics import accuracy
from ml.ope.linear.estimator import LinearConfig, LinearModel
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.population import PARTICIPANTS, run_session, run_sessions
from ml.population.virtual import (
    MECHANISMS,
    WORLDS_PER_PART,
    World,
    draw_patient,
    is_responder,
    new_days,
    simple_policies,
    simulate,
    world,
)  # fmt: skip
from ml.population.virtual.world import PAUSE_H, STEPS, visit_plan

REQUIRED, REQUIRED_COHORT = 20_000, 2000
"""Sessions of a virtual patient per CPU minute; simulated seconds of a detailed participant per CPU second."""
SETTLE_AND_LEAD_S = 2.0 * (5 + 10)
DESIGNS = ("paper", "stratified", "ladder")
VISITS = (1, 2, 3)
POLICY = ProportionalPolicy(0.6, 1.6, 0.3, 5)


def sessions_per_cpu_minute(kind: int, sessions: int = 1000, *, readable: bool = False) -> float:
    """Measure simulated sessions of 300 steps per CPU minute, their noise and outcomes included."""
    patient = draw_patient(kind, np.random.default_rng(kind))
    start = time.process_time()
    simulate(patient, 1.0, POLICY, days=new_days(1, 0, sessions), key=1, steps=STEPS, readable=readable)
    return 60 * sessions / (time.process_time() - start)


def speed() -> dict[str, float]:
    """Measure sessions per CPU minute by mechanism, and of the readable equations for comparison."""
    simulate(draw_patient(0, np.random.default_rng(0)), 1.0, POLICY, days=new_days(1, 0, 2), key=1, steps=2)  # compile
    found = {MECHANISMS[k]: sessions_per_cpu_minute(k) for k in range(len(MECHANISMS))}
    print(f"{'mechanism':<14}{'sessions per CPU minute':>26}")
    for name, value in found.items():
        print(f"{name:<14}{value:>26,.0f}")
    readable = float(np.mean([sessions_per_cpu_minute(k, 50, readable=True) for k in range(len(MECHANISMS))]))
    print(f"{'equations':<14}{readable:>26,.0f}   (readable twin, 50 sessions at a time)")
    return found | {"readable": readable}


def cohort_speed() -> float:
    """Measure simulated seconds per CPU second of the slowest detailed participant."""
    run_session("P1", "random", seed=0, steps=2)  # compile
    found = {}
    for code in PARTICIPANTS:
        started = time.process_time()
        run_sessions(code, "random", seeds=np.arange(8), study_seed=np.arange(8), steps=STEPS)
        found[code] = 8 * (2.0 * STEPS + SETTLE_AND_LEAD_S) / (time.process_time() - started)
    print("simulated s per CPU s: " + ", ".join(f"{code} {speed:,.0f}" for code, speed in found.items()))
    return min(found.values())


def describe(part: str, indices: list[int], sessions: int) -> dict[str, float]:
    """Describe a part: responders, the range of true returns, who gains by following beta."""
    rows = []
    for index in indices:
        w = world(part, index)  # type: ignore[arg-type]
        candidates = w.candidates()
        truths = {n: w.truth(p, sessions) for n, p in candidates.items()}
        cdbs = w.truth(ConstantPolicy(1.0), sessions)
        simple = {n: w.truth(p, sessions) for n, p in simple_policies(w.settings, w.spread).items()}
        follows = truths["proportional slow"]
        matched = w.truth(ConstantPolicy(follows.amplitude.value), sessions)
        gap = follows.returns - matched.returns
        v = np.array([t.total.value for t in truths.values()])
        rows.append(
            {
                "responder": is_responder(simple, cdbs),
                "range": float(np.ptp(v)),
                "error": float(np.mean([t.total.standard_error for t in truths.values()])),
                "best": max(truths, key=lambda n: truths[n].total.value),
                "follow": float(gap.mean()),
                "follow_sure": bool(gap.mean() > 2 * gap.std(ddof=1) / np.sqrt(gap.size)),
                "lower_is_better": truths["constant low"].total.value > cdbs.total.value,
            }
        )
    ranges, gains = np.array([r["range"] for r in rows]), np.array([r["follow"] for r in rows])
    print(f"\npart {part}, {len(rows)} worlds, {sessions} sessions behind each true return")
    print(f"responders: {sum(r['responder'] for r in rows)}; a lower sustained dose is better: {sum(r['lower_is_better'] for r in rows)}")
    print(f"range of true returns: median {np.median(ranges):.0f} ({ranges.min():.0f} to {ranges.max():.0f})")
    print(f"  its standard error, share of the range: median {np.median([r['error'] / r['range'] for r in rows]):.3f}")
    print(f"gain of following beta over a constant of the same mean: {gains.min():.0f} to {gains.max():.0f}, above 0 beyond its error in "
          f"{sum(r['follow_sure'] for r in rows)}")  # fmt: skip
    print("best candidate:", ", ".join(f"{n} {k}" for n, k in Counter(r["best"] for r in rows).most_common()))
    return {
        "responders_share": float(np.mean([r["responder"] for r in rows])),
        "lower_dose_better_share": float(np.mean([r["lower_is_better"] for r in rows])),
        "following_gains_share": float(np.mean([r["follow_sure"] for r in rows])),
    }


def minutes_of(w: World, design: Any, visits: int) -> float:
    """Compute the minutes of the visits, pauses between sessions included."""
    rows = visit_plan(w.settings, design, 0, visits)
    return sum(r.amplitudes.size * w.settings.period_s / 60 + 60 * PAUSE_H for r in rows)


def designs(part: str, indices: list[int], sessions: int, figure: Path) -> dict[str, float]:
    """Measure the accuracy of the linear model by design and visits; the figure has a group of bars for each number of visits."""
    found: dict[str, dict[str, dict[str, list[float]]]] = {}
    for index in indices:
        w = world(part, index)  # type: ignore[arg-type]
        candidates = w.candidates()
        truth = [w.truth(p, sessions).total.value for p in candidates.values()]
        for visits in VISITS:
            for design in DESIGNS:
                fitted = LinearModel(LinearConfig(draws=20)).fit(w.data(design, visits=visits))  # type: ignore[arg-type]
                a = accuracy(truth, [e.value for e in fitted.evaluate(candidates, STEPS).values()])
                into = found.setdefault(f"{visits} visits", {}).setdefault(design, {})
                for metric, value in (
                    ("rank correlation", a.rank_correlation or 0.0),
                    ("regret, % of range", 100 * (a.regret_of_range or 0.0)),
                    ("MAE, % of range", 100 * (a.mae_of_range or 0.0)),
                ):
                    into.setdefault(metric, []).append(value)
    print(f"\nlinear model on {len(indices)} worlds of part {part}: mean +- standard error over worlds")
    w = world(part, indices[0])  # type: ignore[arg-type]
    for group, table in found.items():
        for design, metrics in table.items():
            minutes = minutes_of(w, design, int(group.split()[0]))
            texts = [f"{m} {np.mean(v):.2f} +- {np.std(v, ddof=1) / np.sqrt(len(v)):.2f}" for m, v in metrics.items()]
            print(f"{group}, {minutes:.0f} minutes, {design:<11}{'; '.join(texts)}")
    figure.write_text(draw(found, ("rank correlation", "regret, % of range", "MAE, % of range")))
    print(f"figure: {figure}")
    return {f"rank_{d}_{g.split()[0]}_visits": float(np.mean(m["rank correlation"])) for g, t in found.items() for d, m in t.items()}


def main() -> None:
    """Print tables and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("A", "B"), default="A")
    parser.add_argument("--quick", action="store_true", help="every tenth world and no comparison of designs")
    parser.add_argument("--every", type=int, default=10, help="designs are compared on every so many-th world")
    parser.add_argument("--truth", type=int, default=200, help="simulated sessions behind each true return")
    parser.add_argument("--out", type=Path, help="folder of the figure; a temporary one by default")
    chosen = parser.parse_args()
    look(chosen.part, " ".join(["population.py", *sys.argv[1:]]))
    print(said())
    figures = {f"sessions_per_cpu_minute_{k}": round(v) for k, v in speed().items()}
    figures["cohort_s_per_cpu_s"] = round(cohort_speed())
    every = list(range(WORLDS_PER_PART))
    result: dict[str, Any] = dict(figures) | describe(chosen.part, every[:: chosen.every] if chosen.quick else every, chosen.truth)
    if not chosen.quick:
        out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-population-"))
        out.mkdir(parents=True, exist_ok=True)
        result |= designs(chosen.part, every[:: chosen.every], chosen.truth, out / "designs.svg")
    slowest = min(v for k, v in figures.items() if k.startswith("sessions") and not k.endswith("readable"))
    ratios = {"slowest_to_required": slowest / REQUIRED, "cohort_to_required": figures["cohort_s_per_cpu_s"] / REQUIRED_COHORT}
    ratios |= {"kernel_to_readable": slowest / figures["sessions_per_cpu_minute_readable"]}
    print(
        json.dumps({"name": "population", "figures": result, "ratios": ratios, "baseline": {"required_sessions_per_cpu_minute": REQUIRED}})
    )


if __name__ == "__main__":
    run_benchmark(main)
