"""Six visits of the synthetic participants, margins locked before: how many questions are concluded, and how many conclusions are true?

    python benchmarks/visits_in_silico.py --quick
    python benchmarks/visits_in_silico.py [--seeds 40] [--visits 6] [--minutes 120] [--json FILE]

A question is one controller of one participant in one study: is it non-inferior to cDBS on grasp, rating and tremor, and does it save
energy? A visit is the day that the service plans (`app.planning.plans.schedule`) with as many policies of the controller as fit into its
minutes, by default four sessions of the controller with three of cDBS between them, 10 minutes each. The verdict is the service's own
(`app.analysis.primary.verdict`); the truth is a large sample over other days at the same hours. Beside it stands what a judge would conclude
of the same sessions who knows the standard deviation of every outcome's contrast (`known`): no test of these averages can do better. The
participants are synthetic and not fitted to patients. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from app.analysis.evidence.facts import Facts
from app.analysis.primary.verdict import LockedMargins, verdicts
from app.study.blinding import Arm
from app.study.models import Controller
from ml.policies.policy import ConstantPolicy
from ml.population import PARTICIPANTS, run_sessions
from ml.population.sessions import SessionBatch
from ml.qoc import Margins
from ml.statistics.noninferiority import Inferior, NonInferiorAndSaving

out = sys.stdout.write
STEPS_PER_MINUTE = 30
LEVELS = (0.75, 0.5, 0.3)
"""Constant fractions of the cDBS amplitude: from what hardly differs to what surely harms."""

MARGINS = Margins()
LOCKED_AT = datetime(2026, 1, 1, tzinfo=UTC)
TRUTH_SESSIONS = 200
Means = dict[str, float]


@dataclass(frozen=True)
class Day:
    """The planned day: places in it and hours since its start by arm, steps of a session."""

    places: dict[bool, tuple[int, ...]]
    hours: dict[bool, tuple[float, ...]]
    steps: int

    @classmethod
    def planned(cls, minutes: float) -> Day:
        """The service's plan with as many policies as fit."""
        rules = Rules(total_minutes=minutes)
        sessions = schedule([Candidate(i, Controller.RL) for i in range(most_policies(rules))], rules, seed=0)
        arms = {tested: [i for i, s in enumerate(sessions) if (s.controller is Controller.RL) == tested] for tested in (True, False)}
        hours = {tested: tuple(sessions[i].start_minute / 60 for i in places) for tested, places in arms.items()}
        return cls({tested: tuple(places) for tested, places in arms.items()}, hours, round(rules.session_minutes * STEPS_PER_MINUTE))


@dataclass(frozen=True)
class Question:
    """One question: what was concluded (`good`, `bad` or nothing), whether that is true, and the average loss of every outcome.

    Attributes:
        losses: average over visits by outcome, in margins. spread: variance of one visit's contrast as estimated, in squared margins.
    """

    participant: str
    level: float
    concluded: str
    true: bool | None
    losses: dict[str, float]
    spread: dict[str, float]


def metrics(batch: SessionBatch) -> list[dict[str, float]]:
    """The metrics of every session."""
    found = []
    for amplitude, outcome in zip(batch.amplitude, batch.outcomes, strict=True):
        qoc = outcome.qoc
        values = {"energy": float(np.mean(amplitude**2)), "grasp": qoc.grasp_hz, "rating": outcome.rating, "tremor": qoc.tremor_percent}
        found.append({name: float(value) for name, value in values.items() if value is not None})
    return found


def simulate(code: str, level: float, visits: Sequence[int], hours: Sequence[float], studies: Sequence[int], seed: int) -> SessionBatch:
    """Sessions at a constant level (1 is cDBS)."""
    rng = np.random.default_rng([seed, round(100 * level)])
    controller = "cdbs" if level == 1 else ConstantPolicy(level)
    seeds = rng.integers(0, 2**63, len(visits), dtype=np.uint64)
    return run_sessions(code, controller, visits=visits, hours=hours, seeds=seeds, study_seed=studies, steps=STEPS)


def truth(code: str, level: float, seed: int) -> Means:
    """True means of a level over days, at the hours of its sessions."""
    places = 2 * np.arange(EACH) + (level != 1)
    n = TRUTH_SESSIONS
    rng = np.random.default_rng(seed)
    hours = HOURS_APART * rng.choice(places, n)
    batch = simulate(code, level, rng.integers(1, 7, n).tolist(), hours.tolist(), rng.integers(1, 2**62, n).tolist(), seed + 1)
    rows = metrics(batch)
    return {name: float(np.mean([r[name] for r in rows if name in r])) for name in ("energy", "grasp", "rating", "tremor")}


def beyond(level: Means, cdbs: Means) -> set[str]:
    """Outcomes whose true loss is beyond its margin."""
    losses = {name: cdbs[name] - level[name] for name in ("grasp", "rating")} | {"tremor": level["tremor"] - cdbs["tremor"]}
    margins = {"grasp": MARGINS.grasp_share * cdbs["grasp"], "rating": MARGINS.rating_points, "tremor": MARGINS.tremor_points}
    return {name for name, loss in losses.items() if loss > margins[name]}


def day(visit: int) -> datetime:
    """When a visit's sessions were recorded: after the lock."""
    return LOCKED_AT + timedelta(days=28 * visit)


def study(code: str, seed: int, visits: int) -> dict[float, list[Facts]]:
    """Sessions of one study by level, cDBS among them under 1."""
    found = {}
    for level in (1.0, *LEVELS):
        days = np.repeat(np.arange(1, visits + 1), EACH)
        place = np.tile(2 * np.arange(EACH) + (level != 1), visits)
        batch = simulate(code, level, days.tolist(), (HOURS_APART * place).tolist(), [seed + 1] * days.size, 7919 * (seed + 1))
        arm = Arm(Controller.CDBS if level == 1 else Controller.RL, None)
        found[level] = [
            Facts(i, int(v), int(v), int(p), arm, None, None, day(int(v)), 300.0, row, {}, None, None, (), None, None)
            for i, (v, p, row) in enumerate(zip(days, place, metrics(batch), strict=True))
        ]
    return found


def questions(code: str, seeds: Sequence[int], visits: int) -> list[Question]:
    """Every question of one participant."""
    cdbs = truth(code, 1.0, 101)
    means = {level: truth(code, level, 101) for level in LEVELS}
    locked = LockedMargins(MARGINS, 1, LOCKED_AT, "benchmark")
    found = []
    for seed in seeds:
        sessions = study(code, seed, visits)
        for level in LEVELS:
            (result,) = verdicts([*sessions[1.0], *sessions[level]], [Controller.RL], locked)
            verdict = result.assessment.verdict if result.assessment else None
            harmed = beyond(means[level], cdbs)
            if isinstance(verdict, NonInferiorAndSaving):
                found.append(Question(code, level, "good", not harmed and means[level]["energy"] < cdbs["energy"]))
            elif isinstance(verdict, Inferior):
                found.append(Question(code, level, "bad", set(verdict.outcomes) <= harmed))
            else:
                found.append(Question(code, level, "", None))
    return found


def main() -> None:
    """Run, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--visits", type=int, default=6)
    parser.add_argument("--quick", action="store_true", help="four seeds")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    seeds, started = range(4 if asked.quick else asked.seeds), time.process_time()
    asks = [q for code in PARTICIPANTS for q in questions(code, seeds, asked.visits)]
    concluded = [q for q in asks if q.concluded]
    out("participant  level  non-inferior and saving  inferior  inconclusive  false\n")
    for code in PARTICIPANTS:
        for level in LEVELS:
            mine = [q for q in asks if (q.participant, q.level) == (code, level)]
            count = Counter(q.concluded for q in mine)
            out(f"{code:11}  {level:5.2f}  {count['good']:23}  {count['bad']:8}  {count['']:12}  {sum(q.true is False for q in mine):5}\n")
    figures = {
        "questions": len(asks),
        "concluded": len(concluded) / len(asks),
        "true": sum(bool(q.true) for q in concluded) / len(concluded) if concluded else None,
        "false_non_inferior": sum(q.concluded == "good" and not q.true for q in asks),
        "cpu_s": round(time.process_time() - started, 1),
    }
    out(json.dumps(figures) + "\n")
    if asked.json:
        asked.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
