"""All participants of a caller: N-of-1 results, the random-effects summary, and the tables of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis.evidence.facts import METRICS
from app.analysis.evidence.service import of_all
from app.analysis.metrics import service as metrics
from app.analysis.metrics.service import FiveMetrics
from app.analysis.pooled import repository
from app.analysis.primary import service as primary
from app.analysis.primary.results import PLANNED
from app.analysis.primary.service import Primary
from app.analysis.trial_time.service import TrialTime, of_evidence
from app.platform.kept import kept
from app.study import repository as study
from app.tables.participants import Participant
from app.tables.sessions import Controller
from ml.statistics.pooling import Summary, pool
from ml.statistics.within_visits.contrasts import Average, Reason, Unavailable

MOST = 200
"""Participants on one page."""


@dataclass(frozen=True)
class PooledMetric:
    """One metric of one controller over participants.

    Attributes:
        each: participant and its own result. summary: random effects over those that have one. units: differing units are not pooled.
    """

    metric: str
    each: tuple[tuple[str, Average | Unavailable], ...]
    summary: Summary | Unavailable


@dataclass(frozen=True)
class PooledController:
    """All metrics of a controller."""

    controller: Controller
    metrics: tuple[PooledMetric, ...]


@dataclass(frozen=True)
class Pooled:
    """Everything of the participants that a caller may read."""

    participants: tuple[Primary, ...]
    paper: tuple[FiveMetrics, ...]
    controllers: tuple[PooledController, ...]
    trial: TrialTime


def readable(db: Session, caller: Caller) -> Sequence[Participant]:
    """The participants that the caller may read, by code."""
    return study.participants(db, caller, MOST, 0)[0]


def pooled(db: Session, participants: Sequence[Participant], caller: Caller) -> Pooled:
    """Results of each participant and over all of them."""
    held = of_all(db, participants, caller)
    found, paper = tuple(primary.of_all(db, participants, held)), tuple(metrics.of_all(db, participants, held))
    key = ("pooled", tuple((p.evidence.key, p.locked) for p in found))
    return Pooled(found, paper, kept(key, lambda: tuple(_controller(found, c) for c in PLANNED if _ran(found, c))), of_evidence(held))


@dataclass(frozen=True)
class StepTime:
    """Time of one kind of compute step, s."""

    job: str
    step: str
    n: int
    median_s: float
    longest_s: float


def computation_times(db: Session, participants: Sequence[Participant]) -> list[StepTime]:
    """How long the compute steps of these participants' jobs took."""
    rows = repository.step_seconds(db, [p.id for p in participants])
    return [StepTime(kind, step, n, float(median), float(longest)) for kind, step, n, median, longest in rows]


def _ran(found: Sequence[Primary], controller: Controller) -> bool:
    return any(r.tested.controller is controller for p in found for r in p.controllers)


def _controller(found: Sequence[Primary], controller: Controller) -> PooledController:
    return PooledController(controller, tuple(_metric(found, controller, m) for m in METRICS))


def _metric(found: Sequence[Primary], controller: Controller, metric: str) -> PooledMetric:
    each: list[tuple[str, Average | Unavailable]] = []
    units = set()
    for p in found:
        mine = next((r for r in p.controllers if r.tested.controller is controller), None)
        if mine is None:
            continue
        comparison = mine.of(metric)
        each.append((p.evidence.participant, comparison.result))
        if isinstance(comparison.result, Average):
            units.add(p.beta_kind if metric == "mean_beta" else None)
    summary = pool([r for _, r in each]) if len(units) < 2 else Unavailable(Reason.NOT_IDENTIFIED)
    return PooledMetric(metric, tuple(each), summary)
