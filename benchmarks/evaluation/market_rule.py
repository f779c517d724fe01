"""Worth of the threshold rule that is exported for a policy: does it return in the simulator what its sheet promises, and what is lost?

    python -m benchmarks.evaluation.market_rule --quick             six worlds, few simulated sessions
    python -m benchmarks.evaluation.market_rule --out FOLDER        the 60 worlds of part A; resumable
    python -m benchmarks.evaluation.market_rule --part B ...        patients to report on; each run is counted

In each world of the second population the data are three stratified visits. The policy is that of the highest estimated return which is no
constant. Its rule is `ml.policies.closest_rule.closest_rule`, with limits from 0 to cDBS (3 mA) in steps of 0.1 mA. The promise is the
posterior's estimate from the same data; the truth are simulated sessions under the rule, run by the device's own time steps. Differences
are shares of the range of the true returns of all candidates. A rule is close up to `CLOSE`. The reference is the rule that clinics begin
with. CPU seconds of one thread.
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

from benchmarks.support.cells import Cells
from benchmarks.support.looks import look, said
from benchmarks.support.results import emit, run_benchmark
from ml.ope.compare.gain import gain_over
from ml.ope.posterior.estimator import build
from ml.policies.closest_rule import CLOSE, AmplitudeRange, closest_rule, usual_rule
from ml.policies.policy import ConstantPolicy
from ml.policies.threshold_rule import ThresholdPolicy
from ml.population.virtual import WORLDS_PER_PART, world
from ml.population.virtual.world import STEPS

TRUTH, QUICK_TRUTH, QUICK_WORLDS = 150, 40, 6
CDBS_MA = 3.0
CDBS, RULE, USUAL = "cDBS", "closest rule", "usual rule"
NEAR = 0.05
Row = dict[str, Any]


def cell(part: str, index: int, truth: int) -> Row:
    """Export the rule of one world's best policy, and compare what was promised with what is true."""
    w = world(part, index, 2)  # type: ignore[arg-type]
    data, candidates = w.data("stratified"), w.candidates()
    fitted = build("posterior", 0, "demo").fit(data)
    estimates = fitted.evaluate(candidates, STEPS)
    chosen = max((n for n, p in candidates.items() if not isinstance(p, ConstantPolicy)), key=lambda n: estimates[n].value)
    allowed = AmplitudeRange(0.0, CDBS_MA)
    period = w.settings.period_s
    found = closest_rule(candidates[chosen], data, CDBS_MA, allowed)
    rules = {
        RULE: ThresholdPolicy(found.rule, CDBS_MA, period),
        USUAL: ThresholdPolicy(usual_rule(data, allowed), CDBS_MA, period),
    }
    policies = {chosen: candidates[chosen], CDBS: ConstantPolicy(1.0), **rules}
    promised = fitted.evaluate(policies, STEPS)
    truths = {name: w.truth(policy, truth) for name, policy in {**candidates, **policies}.items()}
    true = {name: t.total.value for name, t in truths.items()}
    loss = gain_over(promised[RULE], promised[chosen])
    return {
        "policy": chosen,
        "mode": found.rule.mode if found.rule.lower_ma < found.rule.upper_ma else "constant",
        "rms": found.closeness.rms_ma / CDBS_MA,
        "range": max(true[n] for n in candidates) - min(true[n] for n in candidates),
        "promised": {n: [promised[n].value, promised[n].low, promised[n].high] for n in policies if n != chosen}
        | {"policy": [promised[chosen].value, promised[chosen].low, promised[chosen].high]},
        "true": {n: true[n] for n in (RULE, USUAL, CDBS)} | {"policy": true[chosen]},
        "lost": [loss.value, loss.low, loss.high],
        "energy": {"promised": promised[RULE].predicted["energy"], "true": truths[RULE].energy.value},
    }


def figures(rows: list[Row]) -> dict[str, tuple[float, float]]:
    """Compute means over worlds with their standard errors, shares of the range."""

    def mean(values: list[float]) -> tuple[float, float]:
        v = np.array(values, dtype=np.float64)
        return float(v.mean()), float(v.std(ddof=1) / np.sqrt(v.size)) if v.size > 1 else float("nan")

    def miss(r: Row, name: str) -> float:
        return abs(r["promised"][name][0] - r["true"][name]) / r["range"]

    def covered(r: Row, name: str) -> bool:
        return bool(r["promised"][name][1] <= r["true"][name] <= r["promised"][name][2])

    def of_loss(r: Row) -> float:
        return abs(r["lost"][0] - (r["true"][RULE] - r["true"]["policy"])) / r["range"]

    found = {}
    for name in (RULE, "policy", CDBS, USUAL):
        found[f"{name}: promise within 5 %"] = mean([miss(r, name) <= NEAR for r in rows])
        found[f"{name}: distance of the promise"] = mean([miss(r, name) for r in rows])
        found[f"{name}: interval covers"] = mean([covered(r, name) for r in rows])
    found["loss to the policy: promise within 5 %"] = mean([of_loss(r) <= NEAR for r in rows])
    found["loss to the policy: distance of the promise"] = mean([of_loss(r) for r in rows])
    close = [r for r in rows if r["rms"] <= CLOSE]
    found["rules that are close to the policy"] = mean([r["rms"] <= CLOSE for r in rows])
    found["of these: promise of the loss within 5 %"] = mean([of_loss(r) <= NEAR for r in close])
    found["of these: distance of the promise"] = mean([of_loss(r) for r in close])
    found["of these: true loss"] = mean([(r["true"]["policy"] - r["true"][RULE]) / r["range"] for r in close])
    found["loss to the policy: interval covers"] = mean(
        [r["lost"][1] <= r["true"][RULE] - r["true"]["policy"] <= r["lost"][2] for r in rows]
    )
    found["true loss to the policy"] = mean([(r["true"]["policy"] - r["true"][RULE]) / r["range"] for r in rows])
    found["true gain over the usual rule"] = mean([(r["true"][RULE] - r["true"][USUAL]) / r["range"] for r in rows])
    found["true gain over cDBS"] = mean([(r["true"][RULE] - r["true"][CDBS]) / r["range"] for r in rows])
    found["energy: distance of the promise"] = mean([abs(r["energy"]["promised"] - r["energy"]["true"]) for r in rows])
    found["difference in amplitude, of cDBS"] = mean([r["rms"] for r in rows])
    found["rules that are a constant"] = mean([r["mode"] == "constant" for r in rows])
    return found


def main() -> None:
    """Print the figures and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_WORLDS} worlds, few simulated sessions")
    parser.add_argument("--part", default="A", choices=("A", "B"), help="A to develop on, B to report on")
    parser.add_argument("--worlds", type=int, default=WORLDS_PER_PART)
    parser.add_argument("--out", type=Path, help="folder of finished worlds; a temporary one by default")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    look(chosen.part, " ".join(["market_rule.py", *sys.argv[1:]]), None)
    emit(f"{said()}\n")
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-market-rule-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / f"market-rule{'-quick' if chosen.quick else ''}.jsonl")
    prefix, number = f"{chosen.part}-", min(QUICK_WORLDS, chosen.worlds) if chosen.quick else chosen.worlds
    for index in range(number):
        key = f"{prefix}{index:02d}"
        if cells.get(key) is None:
            start = time.process_time()
            rows = cell(chosen.part, index, QUICK_TRUTH if chosen.quick else TRUTH)
            cells.add(key, rows=rows, seconds=time.process_time() - start)
    found = figures([c["rows"] for c in cells.all(prefix)])
    emit(f"{number} worlds of part {chosen.part}\n{'':<46}{'':>8}{'error':>8}\n")
    for name, (value, error) in found.items():
        emit(f"{name:<46}{value:>8.3f}{error:>8.3f}\n")
    shown = {name: round(value, 4) for name, (value, _) in found.items() if np.isfinite(value)}
    shown["cpu_seconds_per_world"] = float(np.mean([c["seconds"] for c in cells.all(prefix)]))
    emit(json.dumps({"name": "market_rule", "figures": shown, "ratios": {}, "baseline": "what is true"}) + "\n")


if __name__ == "__main__":
    run_benchmark(main)
