"""Six visits of the synthetic participants, margins locked before: how many questions are concluded, and how many conclusions are true?

    python benchmarks/visits_in_silico.py --quick
    python benchmarks/visits_in_silico.py [--seeds 40] [--first-seed 1] [--visits 6] [--minutes 120] [--session-minutes 5]
        [--only P1] [--keep FOLDER] [--json FILE]

A question is one controller of one participant in one study: is it non-inferior to cDBS on grasp, rating and tremor, and does it save
energy? A visit is the day that the service plans (`app.planning.protocol.schedule`) with as many sessions of the controller as fit into its
minutes, a cDBS session between any two of them: of 5 minutes, the protocol's shortest, six against five, of 10 minutes, the service's
default, four against three. Studies whose first seeds lie apart by the number of seeds have nothing in common. The verdict is the service's
own (`app.analysis.primary_verdict`); the truth is a large sample over other days at the same hours. Besides, `bound` is what would be
concluded from the same averages by an analyst who knows the standard deviation of every outcome: no test of these averages at these levels
can conclude much more. The participants are synthetic and not fitted to patients. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from scipy.special import ndtr
from support.results import emit, run_benchmark

from app.analysis.facts import Facts
from app.analysis.primary_verdict import LockedMargins, verdicts
from app.planning.protocol.schedule import MOST_REPEATS, SESSION_MINUTES, Candidate, Rules, most_policies, schedule
from app.study.blinding import Arm
from app.tables.sessions import Controller
from ml.outcomes import OUTCOMES
from ml.policies.policy import ConstantPolicy
from ml.population import PARTICIPANTS, run_sessions
from ml.qoc import Margins, failed_qoc
from ml.statistics.multiplicity import hommel
from ml.statistics.noninferiority import Assessment, Inferior, NonInferiorAndSaving
from ml.statistics.within_visits.contrasts import Average, Unavailable

STEPS_PER_MINUTE = 30
LEVELS = (0.75, 0.5, 0.3)
"""Constant fractions of the cDBS amplitude: from what hardly differs to what surely harms."""

MARGINS = Margins()
LOCKED_AT = datetime(2026, 1, 1, tzinfo=UTC)
TRUTH_SESSIONS = 200
GOOD, BAD, OPEN = "good", "bad", ""
Means = dict[str, float]


@dataclass(frozen=True)
class Day:
    """The planned day: places in it and hours since its start, of the controller (True) and of cDBS, and steps of a session."""

    places: dict[bool, list[int]]
    hours: list[float]
    steps: int

    @classmethod
    def planned(cls, rules: Rules) -> Day:
        """Lay out the service's plan with as many sessions of the controller as fit: policies of it, each repeated."""
        repeated = [replace(rules, repeats=r) for r in range(1, MOST_REPEATS + 1)]
        best = max(repeated, key=lambda r: most_policies(r) * r.repeats)
        sessions = schedule([Candidate(i, Controller.RL) for i in range(most_policies(best))], best, seed=0)
        places = {tested: [i for i, s in enumerate(sessions) if (s.controller is Controller.RL) == tested] for tested in (True, False)}
        return cls(places, [s.start_minute / 60 for s in sessions], round(rules.session_minutes * STEPS_PER_MINUTE))

    def of(self, level: float) -> list[int]:
        """List the places of a level; 1 is cDBS."""
        return self.places[level != 1]


@dataclass(frozen=True)
class Question:
    """One question: what was concluded, by the service and with known standard deviations, and what the conclusion may be."""

    participant: str
    level: float
    concluded: str
    bound: str
    true: bool | None


def kept(code: str, day: Day, seeds: range, visits: int, folder: Path | None) -> list[Question]:
    """Answer every question of one participant; read where the folder has them from an earlier run of the same studies."""
    name = f"visits-{code}-{seeds.start}-{len(seeds)}-{visits}-{day.steps}-{len(day.places[True])}.json"
    path = folder / name if folder else None
    if path and path.exists():
        return [Question(**row) for row in json.loads(path.read_text())]
    asked = questions(code, day, seeds, visits)
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_suffix(".part")
        draft.write_text(json.dumps([asdict(q) for q in asked]))
        draft.replace(path)
    return asked


def simulate(
    code: str, level: float, visits: Sequence[int], hours: Sequence[float], studies: Sequence[int], steps: int, seed: int
) -> list[Means]:
    """Simulate the metrics of sessions at a constant level."""
    rng = np.random.default_rng([seed, round(100 * level)])
    controller = "cdbs" if level == 1 else ConstantPolicy(level)
    seeds = rng.integers(0, 2**63, len(visits), dtype=np.uint64)
    batch = run_sessions(code, controller, visits=visits, hours=hours, seeds=seeds, study_seed=studies, steps=steps)
    found = []
    for amplitude, outcome in zip(batch.amplitude, batch.outcomes, strict=True):
        values = {"energy": float(np.mean(amplitude**2))} | {o.key: getattr(outcome.qoc, o.field) for o in OUTCOMES}
        found.append({name: float(value) for name, value in values.items() if value is not None})
    return found


def truth(code: str, level: float, day: Day, seed: int) -> Means:
    """Compute the true means of a level over days, at the hours of its sessions."""
    rng, n = np.random.default_rng(seed), TRUTH_SESSIONS
    hours = rng.choice([day.hours[i] for i in day.of(level)], n)
    rows = simulate(code, level, rng.integers(1, 7, n).tolist(), hours.tolist(), rng.integers(1, 2**62, n).tolist(), day.steps, seed + 1)
    return {name: float(np.mean([r[name] for r in rows if name in r])) for name in ("energy", "grasp", "rating", "tremor")}


def beyond(level: Means, cdbs: Means) -> set[str]:
    """List the outcomes whose true loss is beyond its margin."""
    losses = {name: cdbs[name] - level[name] for name in ("grasp", "rating")} | {"tremor": level["tremor"] - cdbs["tremor"]}
    margins = {"grasp": MARGINS.grasp_share * cdbs["grasp"], "rating": MARGINS.rating_points, "tremor": MARGINS.tremor_points}
    return {name for name, loss in losses.items() if loss > margins[name]}


def recorded(visit: int) -> datetime:
    """Return the time of a visit's recordings: after the lock."""
    return LOCKED_AT + timedelta(days=28 * visit)


def studies(code: str, level: float, day: Day, seeds: range, visits: int) -> list[list[Facts]]:
    """Simulate the sessions of a level in every study; one study a seed."""
    mine = day.of(level)
    of_visit = np.tile(np.repeat(np.arange(1, visits + 1), len(mine)), len(seeds)).tolist()
    hours = np.tile([day.hours[i] for i in mine], visits * len(seeds)).tolist()
    of_study = np.repeat(seeds, visits * len(mine)).tolist()
    rows = simulate(code, level, of_visit, hours, of_study, day.steps, 7919 + seeds.start - 1)
    arm = Arm(Controller.CDBS if level == 1 else Controller.RL, None)
    facts = [
        Facts(i, v, v, mine[i % len(mine)], arm, None, None, recorded(v), 60.0 * day.steps / STEPS_PER_MINUTE, row, {}, None, None, (),
              None, None)
        for i, (v, row) in enumerate(zip(of_visit, rows, strict=True))
    ]  # fmt: skip
    each = visits * len(mine)
    return [facts[k * each : (k + 1) * each] for k in range(len(seeds))]


def known_spread(found: Sequence[Assessment]) -> dict[str, float]:
    """Estimate the standard deviation of the average of every outcome, from all studies together."""
    spread: dict[str, list[float]] = {}
    for one in found:
        for o in one.outcomes:
            if isinstance(o.average, Average):
                spread.setdefault(o.name, []).append(o.average.standard_error**2)
    return {name: max(float(np.sqrt(np.mean(squares))), 1e-9) for name, squares in spread.items()}


def bound(found: Assessment, spread: dict[str, float]) -> str:
    """Derive the conclusion from known standard deviations."""
    averages = [(o, o.average) for o in found.outcomes if isinstance(o.average, Average)]
    lost = [float(ndtr((a.estimate + o.margin) / spread[o.name])) for o, a in averages]
    if min(hommel(lost), default=1.0) < found.alpha:
        return BAD
    shown = len(averages) == len(found.outcomes) and all(1 - p < found.alpha for p in lost)
    saves = not isinstance(found.saving, Unavailable) and found.saving.p_value < found.alpha
    return GOOD if shown and saves else OPEN


def questions(code: str, day: Day, seeds: range, visits: int) -> list[Question]:
    """Answer every question of one participant."""
    cdbs, reference = truth(code, 1.0, day, 101), studies(code, 1.0, day, seeds, visits)
    locked = LockedMargins(MARGINS, 1, LOCKED_AT, "benchmark")
    asked = []
    for level in LEVELS:
        mean = truth(code, level, day, 101)
        harmed, saves = beyond(mean, cdbs), mean["energy"] < cdbs["energy"]
        results = []
        for theirs, ours in zip(reference, studies(code, level, day, seeds, visits), strict=True):
            (result,) = verdicts([*theirs, *ours], [Controller.RL], locked, failed_qoc([]))  # none is stopped
            if result.assessment is None:
                raise SystemExit(f"{code} at {level}: no verdict, {result.no_verdict}")
            results.append(result.assessment)
        spread = known_spread(results)
        for found in results:
            verdict, known = found.verdict, bound(found, spread)
            if isinstance(verdict, NonInferiorAndSaving):
                asked.append(Question(code, level, GOOD, known, not harmed and saves))
            elif isinstance(verdict, Inferior):
                asked.append(Question(code, level, BAD, known, set(verdict.outcomes) <= harmed))
            else:
                asked.append(Question(code, level, OPEN, known, None))
    return asked


def main() -> None:
    """Run, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--visits", type=int, default=6)
    parser.add_argument("--minutes", type=float, default=Rules().total_minutes, help="of a visit")
    parser.add_argument("--session-minutes", type=float, default=SESSION_MINUTES[0])
    parser.add_argument("--quick", action="store_true", help="four seeds")
    parser.add_argument("--only", choices=PARTICIPANTS, help="one participant")
    parser.add_argument("--keep", type=Path, help="a folder for finished participants, which a later run of the same code reads")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    day = Day.planned(Rules(session_minutes=asked.session_minutes, total_minutes=asked.minutes))
    seeds, started = range(asked.first_seed, asked.first_seed + (4 if asked.quick else asked.seeds)), time.process_time()
    codes = [asked.only] if asked.only else list(PARTICIPANTS)
    asks = [q for code in codes for q in kept(code, day, seeds, asked.visits, asked.keep)]
    concluded = [q for q in asks if q.concluded]
    emit(f"{asked.visits} visits of {len(day.places[True])} sessions of the controller and {len(day.places[False])} of cDBS, ")
    emit(f"{asked.session_minutes:g} minutes each\nparticipant  level  non-inferior and saving  inferior  inconclusive  false  bound\n")
    for code in codes:
        for level in LEVELS:
            mine = [q for q in asks if (q.participant, q.level) == (code, level)]
            count, known = Counter(q.concluded for q in mine), sum(bool(q.bound) for q in mine)
            emit(f"{code:11}  {level:5.2f}  {count[GOOD]:23}  {count[BAD]:8}  {count[OPEN]:12}  ")
            emit(f"{sum(q.true is False for q in mine):5}  {known:5}\n")
    figures = {
        "questions": len(asks),
        "concluded": len(concluded) / len(asks),
        "true": sum(bool(q.true) for q in concluded) / len(concluded) if concluded else None,
        "false_non_inferior": sum(q.concluded == GOOD and not q.true for q in asks),
        "bound": sum(bool(q.bound) for q in asks) / len(asks),
        "cpu_s": round(time.process_time() - started, 1),
    }
    emit(json.dumps(figures) + "\n")
    if asked.json:
        asked.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    run_benchmark(main)
