"""All participants together: a result for each, a summary that claims nothing about a population, and the paper's tables."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import Row, func, select
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis import evidence, metrics, primary
from app.analysis.evidence import Evidence
from app.analysis.facts import METRICS, BetaKind, LeftOut, comparable_beta, with_comparable_beta
from app.analysis.metrics import FiveMetrics
from app.analysis.primary_results import planned_results
from app.analysis.primary_verdict import VerdictResult
from app.platform.kept import kept, summaries
from app.study import repository as study
from app.study.blinding import CONTROLLER_NAMES, Arm, visible_arms
from app.tables.jobs import Job, JobStatus, JobStep
from app.tables.participants import Participant
from app.tables.sessions import LEARNED, Controller, StudySession
from ml.statistics.pooling import Summary, pool
from ml.statistics.within_visits.contrasts import Average, Reason, Unavailable

# Minutes that each controller was tested in each participant: the table of trial time (Gao et al. 2023, section 6.1).

PAPER_ORDER = (Controller.CDBS, Controller.RL, Controller.DISTILLED, Controller.NO_DBS)
"""The paper's columns; controllers that it does not list follow where some session has them."""


@dataclass(frozen=True)
class TimeTested:
    """One controller in one participant: confirmed sessions that are not excluded, and their minutes."""

    controller: Controller
    sessions: int
    minutes: float


@dataclass(frozen=True)
class TrialTimeRow:
    """One participant.

    Attributes:
        tested: one entry for each of the table's controllers, with zeros where it was not tested.
        excluded: sessions that a user excluded.
    """

    participant: str
    tested: list[TimeTested]
    excluded: int


@dataclass(frozen=True)
class TrialTime:
    """The table; `totals` and `excluded` over all participants, also where `rows` are some of them."""

    controllers: list[Controller]
    labels: list[str]
    rows: list[TrialTimeRow]
    totals: list[TimeTested]
    excluded: int


def trial_time(db: Session, participants: Sequence[Participant], caller: Caller) -> TrialTime:
    """Build the table over these participants, in their order. Proposed and excluded sessions do not count."""
    by_participant: dict[int, list[StudySession]] = {p.id: [] for p in participants}
    for session in study.sessions_without_data(db, list(by_participant)):
        by_participant[session.visit.participant_id].append(session)
    counted = []
    for participant in participants:
        held = by_participant[participant.id]
        counting = [s for s in held if s.excluded_reason is None]
        ran = [(arm, s.duration_s) for s, arm in zip(counting, visible_arms(counting, caller), strict=True)]
        counted.append(_Counted(participant.code, ran, sum(s.excluded_reason is not None for s in held)))
    return _table(counted)


def _count(one: Evidence) -> _Counted:
    ran = [(s.arm, s.duration_s) for s in one.sessions] + [(e.arm, e.duration_s) for e in one.excluded]
    return _Counted(one.participant, ran, sum(e.why is LeftOut.EXCLUDED for e in one.excluded))


@dataclass(frozen=True)
class _Counted:
    """Sessions of one participant with their seconds, no arm where it is not known to the reader; and how many are excluded."""

    participant: str
    ran: Sequence[tuple[Arm | None, float]]
    excluded: int


def _table(counted: Sequence[_Counted]) -> TrialTime:
    by_controller: list[dict[Controller, list[float]]] = []
    for one in counted:
        seconds: dict[Controller, list[float]] = {}
        for arm, duration_s in one.ran:
            if arm is not None:
                seconds.setdefault(arm.controller, []).append(duration_s)
        by_controller.append(seconds)
    others = [c for c in Controller if c not in PAPER_ORDER and any(c in seconds for seconds in by_controller)]
    controllers = [*PAPER_ORDER, *others]
    rows = [
        TrialTimeRow(one.participant, [_tested(c, seconds.get(c, [])) for c in controllers], one.excluded)
        for one, seconds in zip(counted, by_controller, strict=True)
    ]
    totals = [_tested(c, [s for seconds in by_controller for s in seconds.get(c, [])]) for c in controllers]
    return TrialTime(controllers, [CONTROLLER_NAMES[c] for c in controllers], rows, totals, sum(one.excluded for one in counted))


def _tested(controller: Controller, seconds: Sequence[float]) -> TimeTested:
    return TimeTested(controller, len(seconds), sum(seconds) / 60)


# Energy that learned controllers have saved so far against the cDBS amplitude, over the minutes that they ran; description, no test.


@dataclass(frozen=True)
class Saved:
    """Saving of learned controllers in one participant.

    Attributes:
        share: 1 less the mean of a^2 over the sessions' minutes; below 0 where they spent more. a is the fraction of the cDBS amplitude on
            the controlled side.
        minutes, sessions: of theirs with a known energy.
    """

    participant: str
    share: float
    minutes: float
    sessions: int


def _saving(held: Evidence) -> Saved | None:
    """Compute the energy saved in one participant; None without a session of a learned controller that the caller may know of and that
    counts.
    """
    ran = [s for s in held.sessions if s.controller in LEARNED and "energy" in s.values]
    seconds = sum(s.duration_s for s in ran)
    if not seconds:
        return None
    spent = sum(s.values["energy"] * s.duration_s for s in ran) / seconds
    return Saved(held.participant, 1 - spent, seconds / 60, len(ran))


def overall(saved: Sequence[Saved]) -> Saved | None:
    """Average all participants, weighted by minutes; None without any."""
    minutes = sum(s.minutes for s in saved)
    if not minutes:
        return None
    return Saved("", sum(s.share * s.minutes for s in saved) / minutes, minutes, sum(s.sessions for s in saved))


# Queries of the study-wide tables.


def step_seconds(db: Session, participant_ids: Sequence[int]) -> Sequence[Row[str, str, int, float, float]]:
    """Query finished compute steps of the participants' jobs: kind of job, step (its key up to the number), n, median and longest, s."""
    seconds = func.extract("epoch", JobStep.finished_at - JobStep.started_at)
    name = func.regexp_replace(JobStep.key, "/[0-9]+$", "")
    return db.execute(
        select(Job.kind, name, func.count(), func.percentile_cont(0.5).within_group(seconds), func.max(seconds))
        .join(JobStep, JobStep.job_id == Job.id)
        .where(Job.participant_id.in_(participant_ids), JobStep.status == JobStatus.SUCCEEDED, JobStep.finished_at.is_not(None))
        .group_by(Job.kind, name)
        .order_by(Job.kind, func.min(JobStep.position))
    ).all()


# All participants of a caller: N-of-1 results, the random-effects summary, and the tables of the paper.


@dataclass(frozen=True)
class Outline:
    """Results of one participant that pages of all participants need.

    Attributes:
        key: changes with whatever they depend on. verdicts: of the learned controllers.
        results: of the planned controllers that ran, by metric. beta_kind: which beta that is. time: tested. saved: energy.
    """

    key: Hashable
    participant: str
    verdicts: tuple[VerdictResult, ...]
    results: Mapping[Controller, Mapping[str, Average | Unavailable]]
    beta_kind: BetaKind | None
    time: _Counted
    saved: Saved | None


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

    participants: tuple[Outline, ...]
    controllers: tuple[PooledController, ...]
    trial: TrialTime


def readable(db: Session, caller: Caller) -> Sequence[Participant]:
    """List by code the readable participants that are summed up: the real ones, or the synthetic ones where there are no others."""
    found = study.participants(db, caller, None, 0)[0]
    return [p for p in found if not p.synthetic] or found


def pooled(db: Session, participants: Sequence[Participant], caller: Caller) -> Pooled:
    """Compute the results of each participant and over all of them."""
    found = outlines(db, participants, caller)
    controllers = kept(("pooled", tuple(o.key for o in found)), lambda: tuple(_controller(found, c) for c in LEARNED if _ran(found, c)))
    return Pooled(tuple(found), controllers, _table([o.time for o in found]))


def outlines(db: Session, participants: Sequence[Participant], caller: Caller) -> list[Outline]:
    """Return outlines of the participants; unchanged ones come from the cache."""
    of_evidence = evidence.keys_of(db, participants, caller)
    keys = [("outline", key, primary.locked_margins(p)[-1]) for key, p in zip(of_evidence, participants, strict=True)]

    def compute(lacking: Sequence[int]) -> Iterator[Outline]:
        for some in evidence.some_at_once(lacking):
            held = evidence.of_all(db, [participants[i] for i in some], caller, [of_evidence[i] for i in some])
            for i, one in zip(some, held, strict=True):
                yield _outline(keys[i], one, participants[i])

    return summaries(keys, compute)


def _outline(key: Hashable, held: Evidence, participant: Participant) -> Outline:
    kind = comparable_beta(held.sessions, held.beta_unit, held.beta_source)
    found = planned_results(with_comparable_beta(held.sessions, kind))
    by_metric = {r.tested.controller: {c.metric: c.result for c in r.comparisons} for r in found}
    return Outline(key, held.participant, primary.verdicts_on(held, participant), by_metric, kind, _count(held), _saving(held))


def paper(db: Session, participants: Sequence[Participant], caller: Caller) -> list[FiveMetrics]:
    """Compute the paper's comparisons of each participant."""
    return metrics.of_all(db, participants, evidence.of_all(db, participants, caller))


@dataclass(frozen=True)
class StepTime:
    """Time of one kind of compute step, s."""

    job: str
    step: str
    n: int
    median_s: float
    longest_s: float


def computation_times(db: Session, participants: Sequence[Participant]) -> list[StepTime]:
    """Return the time that the compute steps of these participants' jobs took."""
    rows = step_seconds(db, [p.id for p in participants])
    return [StepTime(kind, step, n, float(median), float(longest)) for kind, step, n, median, longest in rows]


def _ran(found: Sequence[Outline], controller: Controller) -> bool:
    return any(controller in o.results for o in found)


def _controller(found: Sequence[Outline], controller: Controller) -> PooledController:
    return PooledController(controller, tuple(_metric(found, controller, m) for m in METRICS))


def _metric(found: Sequence[Outline], controller: Controller, metric: str) -> PooledMetric:
    mine = [o for o in found if controller in o.results]
    each = tuple((o.participant, o.results[controller][metric]) for o in mine)
    units = {o.beta_kind if metric == "mean_beta" else None for o in mine if isinstance(o.results[controller][metric], Average)}
    summary = pool([r for _, r in each]) if len(units) < 2 else Unavailable(Reason.NOT_IDENTIFIED)
    return PooledMetric(metric, each, summary)
