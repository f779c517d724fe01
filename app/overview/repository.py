"""Queries that join phases: what the overview says of every participant, in a handful of statements whatever their number; the trail."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import TIMESTAMP, Row, Select, cast, false, func, select, true
from sqlalchemy.dialects.postgresql import distinct_on
from sqlalchemy.orm import Session, joinedload, lazyload

from app.accounts.permissions import Caller
from app.evaluation.schemas import RANKING_KINDS
from app.study.repository import in_scope
from app.tables.accounts import Site, Study
from app.tables.adverse_events import AdverseEvent, AdverseEventRevision, EventKind, Severity
from app.tables.data_queries import DataQuery, DataQueryEntry, QueryState
from app.tables.evaluations import EstimateRow, Evaluation
from app.tables.jobs import Job, JobStatus
from app.tables.learning import BufferSnapshot, Policy
from app.tables.outcomes import QocRevision
from app.tables.participants import MarginsLock, MarginsVersion, Participant
from app.tables.plans import Plan, PlanItem
from app.tables.sessions import StudySession
from app.tables.uploads import Upload, UploadFile
from app.tables.visits import Dose, Visit, VisitLock


def visit_days(db: Session, ids: Sequence[int], today: dt.date) -> Iterable[Row[int, int, dt.date | None, dt.date | None]]:
    """Query by participant: number of visits, the last one up to today, the first from today on."""
    return db.execute(
        select(
            Visit.participant_id,
            func.count(),
            func.max(Visit.date).filter(Visit.date <= today),
            func.min(Visit.date).filter(Visit.date >= today),
        )
        .where(Visit.participant_id.in_(ids))
        .group_by(Visit.participant_id)
    )


def session_counts(db: Session, ids: Sequence[int]) -> Iterable[Row[int, int, int, int, int, dt.datetime | None]]:
    """Count by participant: sessions confirmed, excluded, without QoCs, proposed. Add when the newest one could be learned from: it was
    entered, or the key of its blinded plan was opened."""
    confirmed = StudySession.status == "confirmed"
    counts = confirmed & StudySession.excluded_reason.is_(None)
    has_qoc = select(QocRevision.id).where(QocRevision.session_id == StudySession.id).exists()
    return db.execute(
        select(
            Visit.participant_id,
            func.count().filter(confirmed),
            func.count().filter(confirmed & ~counts),
            func.count().filter(counts & ~has_qoc),
            func.count().filter(~confirmed),
            func.max(func.greatest(StudySession.created_at, Visit.unsealed_at)).filter(confirmed & ~Visit.sealed),
        )
        .join(Visit, Visit.id == StudySession.visit_id)
        .where(Visit.participant_id.in_(ids))
        .group_by(Visit.participant_id)
    )


def policy_counts(db: Session, ids: Sequence[int]) -> Iterable[Row[int, int]]:
    """Count by participant the policies that are no baseline and not retired."""
    policies = select(Policy.participant_id, func.count()).where(Policy.participant_id.in_(ids), Policy.retired_reason.is_(None))
    return db.execute(policies.where(Policy.kind != "baseline").group_by(Policy.participant_id))


def evaluation_times(db: Session, ids: Sequence[int]) -> Iterable[Row[int, dt.datetime, dt.datetime]]:
    """List participant, time of an evaluation and of its buffer snapshot, oldest first."""
    return db.execute(
        select(Evaluation.participant_id, Evaluation.created_at, BufferSnapshot.created_at)
        .join(BufferSnapshot, BufferSnapshot.id == Evaluation.snapshot_id)
        .where(Evaluation.participant_id.in_(ids))
        .order_by(Evaluation.id)
    )


def plan_statuses(db: Session, ids: Sequence[int]) -> Iterable[Row[int, str, dt.date | None]]:
    """List participant, status and visit's date of each plan that is not superseded, by visit."""
    plans = select(Visit.participant_id, Plan.status, Visit.date).join(Visit, Visit.id == Plan.visit_id)
    return db.execute(plans.where(Visit.participant_id.in_(ids), Plan.status != "superseded").order_by(Visit.number))


def job_counts(db: Session, ids: Sequence[int]) -> Iterable[Row[int | None, int, int]]:
    """Count by participant the jobs that wait or run, and those that failed in the last 7 days."""
    live = Job.status.in_([JobStatus.QUEUED, JobStatus.RUNNING])
    lately = (Job.status == JobStatus.FAILED) & (Job.finished_at > func.now() - dt.timedelta(days=7))
    jobs = select(Job.participant_id, func.count().filter(live), func.count().filter(lately)).where(Job.participant_id.in_(ids))
    return db.execute(jobs.group_by(Job.participant_id))


def live_ranking_jobs(db: Session, ids: Sequence[int]) -> Sequence[Job]:
    """List the jobs that wait or run and end with a ranking, newest first."""
    live = Job.status.in_([JobStatus.QUEUED, JobStatus.RUNNING])
    query = select(Job).where(Job.participant_id.in_(ids), live, Job.kind.in_(RANKING_KINDS))
    return db.scalars(query.order_by(Job.created_at.desc())).all()


# Work of the running studies that the caller may read. Each query gives a row per participant: key, code, study, site, count, oldest.

Waiting = Iterable[Row[Any, str, int, int, int, dt.datetime | None]]


def _waiting(caller: Caller, key: Any, oldest: Any) -> Select[Any]:
    columns = key, Participant.code, Site.study_id, Site.id, func.count(), func.min(oldest)
    query = select(*columns).select_from(Participant).join(Participant.site).join(Study, Study.id == Site.study_id)
    return query.where(in_scope(caller), Study.ended_at.is_(None)).group_by(key, Participant.code, Site.study_id, Site.id)


def events_to_clear(db: Session, caller: Caller) -> Waiting:
    """Count adverse events that no clinician has cleared; the key says whether they are serious, else they are stops."""
    newer = AdverseEventRevision.__table__.alias()
    is_newest = ~select(newer.c.id).where(newer.c.event_id == AdverseEvent.id, newer.c.revision > AdverseEventRevision.revision).exists()
    blocks = AdverseEventRevision.serious | (AdverseEventRevision.kind == EventKind.STOPPED)
    query = _waiting(caller, AdverseEventRevision.serious, AdverseEvent.created_at)
    query = query.join(AdverseEvent, AdverseEvent.participant_id == Participant.id).join(AdverseEventRevision)
    return db.execute(
        query.where(is_newest, blocks, AdverseEventRevision.severity != Severity.NONE, AdverseEventRevision.cleared_reason.is_(None))
    )


def queries_not_closed(db: Session, caller: Caller) -> Waiting:
    """Count data queries by their state, open or answered."""
    later = DataQueryEntry.__table__.alias()
    is_newest = ~select(later.c.id).where(later.c.query_id == DataQuery.id, later.c.id > DataQueryEntry.id).exists()
    query = _waiting(caller, DataQueryEntry.state, DataQueryEntry.created_at)
    query = query.join(DataQuery, DataQuery.participant_id == Participant.id).join(DataQueryEntry)
    return db.execute(query.where(is_newest, DataQueryEntry.state != QueryState.CLOSED))


def files_in_quarantine(db: Session, caller: Caller) -> Waiting:
    """Count files that could not be freed of identity and wait for a decision."""
    query = _waiting(caller, Participant.id, Upload.created_at).join(UploadFile, UploadFile.participant_id == Participant.id)
    return db.execute(query.join(Upload, Upload.id == UploadFile.upload_id).where(UploadFile.quarantine_sha256.is_not(None)))


def plans_to_sign(db: Session, caller: Caller) -> Waiting:
    """Count visit plans that are drafts."""
    query = _waiting(caller, Participant.id, Plan.created_at).join(Visit, Visit.participant_id == Participant.id)
    return db.execute(query.join(Plan, Plan.visit_id == Visit.id).where(Plan.status == "draft"))


def margins_to_lock(db: Session, caller: Caller, today: dt.date) -> Waiting:
    """Count plans that test a policy from today on, of participants whose present margins are not locked."""
    newest = select(MarginsVersion.id).where(MarginsVersion.participant_id == Participant.id).order_by(MarginsVersion.id.desc()).limit(1)
    locked = select(MarginsLock.id).where(MarginsLock.margins_version_id == newest.correlate(Participant).scalar_subquery()).exists()
    tests = select(PlanItem.id).where(PlanItem.plan_id == Plan.id, PlanItem.policy_id.is_not(None)).exists()
    query = _waiting(caller, Participant.id, Plan.created_at).join(Visit, Visit.participant_id == Participant.id)
    query = query.join(Plan, Plan.visit_id == Visit.id).where(Plan.status != "superseded", Visit.date >= today)
    return db.execute(query.where(tests, ~locked))


def sessions_to_confirm(db: Session, caller: Caller) -> Waiting:
    """Count sessions that were proposed and not confirmed."""
    query = _waiting(caller, Participant.id, StudySession.created_at).join(Visit, Visit.participant_id == Participant.id)
    return db.execute(query.join(StudySession, StudySession.visit_id == Visit.id).where(StudySession.status != "confirmed"))


def sessions_without_outcomes(db: Session, caller: Caller) -> Waiting:
    """Count confirmed sessions that count and have no outcome."""
    query = _waiting(caller, Participant.id, StudySession.created_at).join(Visit, Visit.participant_id == Participant.id)
    counts = (StudySession.status == "confirmed") & StudySession.excluded_reason.is_(None)
    has_qoc = select(QocRevision.id).where(QocRevision.session_id == StudySession.id).exists()
    return db.execute(query.join(StudySession, StudySession.visit_id == Visit.id).where(counts, ~has_qoc))


_NEWEST_LOCK = select(VisitLock.locked).where(VisitLock.visit_id == Visit.id).order_by(VisitLock.id.desc()).limit(1)
_LOCKED = func.coalesce(_NEWEST_LOCK.correlate(Visit).scalar_subquery(), false())


def latest_visits(db: Session, caller: Caller, first: dt.date, today: dt.date, most: int) -> Sequence[Row[Visit, str, bool]]:
    """List visits from `first` to yesterday with code and whether they are locked: unlocked ones first, then the newest."""
    query = select(Visit, Participant.code, _LOCKED).join(Visit.participant).join(Participant.site).join(Study, Study.id == Site.study_id)
    query = query.where(in_scope(caller), Study.ended_at.is_(None), Participant.status != "withdrawn")
    query = query.where(Visit.date >= first, Visit.date < today)
    return db.execute(query.order_by(_LOCKED, Visit.date.desc(), Participant.code).limit(most).options(lazyload("*"))).all()


def visits_to_come(db: Session, ids: Sequence[int], today: dt.date) -> Sequence[Visit]:
    """Load each participant's first visit from today on."""
    query = select(Visit).where(Visit.participant_id.in_(ids), Visit.date >= today)
    query = query.ext(distinct_on(Visit.participant_id)).order_by(Visit.participant_id, Visit.date, Visit.number)
    return db.scalars(query.options(lazyload("*"))).all()


def late_logs(db: Session, caller: Caller, today: dt.date) -> Waiting:
    """Count slots of signed plans without a confirmed session, of past visits that are not locked; the oldest is the visit's day."""
    filled = select(StudySession.id).where(StudySession.plan_item_id == PlanItem.id, StudySession.status == "confirmed").exists()
    query = _waiting(caller, Visit.id, cast(Visit.date, TIMESTAMP(timezone=True))).join(Visit, Visit.participant_id == Participant.id)
    query = query.join(Plan, Plan.visit_id == Visit.id).join(PlanItem, PlanItem.plan_id == Plan.id)
    query = query.where(Visit.date < today, Plan.status == "approved", PlanItem.max_ma.is_not(None), ~_LOCKED, ~filled)
    return db.execute(query)


@dataclass(frozen=True)
class VisitCounts:
    """Numbers of one visit: its plan's status, its slots and those that a confirmed session fills, sessions, and doses."""

    plan: str | None
    slots: int
    filled: int
    sessions: int
    without_outcomes: int
    proposed: int
    doses: int


def visit_counts(db: Session, visit_ids: Sequence[int]) -> dict[int, VisitCounts]:
    """Count by visit what its day has brought."""
    confirmed = StudySession.status == "confirmed"
    has_qoc = select(QocRevision.id).where(QocRevision.session_id == StudySession.id).exists()
    of_visit = select(
        func.count().filter(confirmed).label("sessions"),
        func.count().filter(confirmed & StudySession.excluded_reason.is_(None) & ~has_qoc).label("without"),
        func.count().filter(~confirmed).label("proposed"),
    ).where(StudySession.visit_id == Visit.id)
    sessions = of_visit.correlate(Visit).lateral()
    doses = select(func.count()).where(Dose.visit_id == Visit.id, Dose.removed_at.is_(None)).correlate(Visit).scalar_subquery()
    plan = select(Plan.status).where(Plan.visit_id == Visit.id, Plan.status != "superseded").correlate(Visit).scalar_subquery()
    of_plan = select(func.count()).select_from(PlanItem).join(Plan, Plan.id == PlanItem.plan_id)
    of_plan = of_plan.where(Plan.visit_id == Visit.id, Plan.status == "approved", PlanItem.max_ma.is_not(None)).correlate(Visit)
    filled = select(StudySession.id).where(StudySession.plan_item_id == PlanItem.id, confirmed).exists()
    columns = plan, of_plan.scalar_subquery(), of_plan.where(filled).scalar_subquery(), sessions.c.sessions, sessions.c.without
    query = select(Visit.id, *columns, sessions.c.proposed, doses).join(sessions, true())
    return {key: VisitCounts(*counts) for key, *counts in db.execute(query.where(Visit.id.in_(visit_ids)))}


def policies(db: Session, participant_id: int) -> Sequence[Policy]:
    """List every policy of a participant, oldest first."""
    return db.scalars(select(Policy).where(Policy.participant_id == participant_id).order_by(Policy.id)).all()


def evaluations(db: Session, participant_id: int) -> Sequence[Evaluation]:
    """List every evaluation of a participant, oldest first."""
    return db.scalars(select(Evaluation).where(Evaluation.participant_id == participant_id).order_by(Evaluation.id)).all()


def estimates(db: Session, participant_id: int) -> Iterable[Row[Evaluation, EstimateRow]]:
    """List every estimate of a participant with its evaluation."""
    return db.execute(
        select(Evaluation, EstimateRow)
        .join(EstimateRow, EstimateRow.evaluation_id == Evaluation.id)
        .where(Evaluation.participant_id == participant_id)
        .order_by(Evaluation.id, EstimateRow.policy_id, EstimateRow.method)
    )


def participant_id_of_code(db: Session, caller: Caller, code: str) -> int | None:
    """Find the row number of a participant that the caller may read, ignoring the code's case; None if there is none."""
    query = select(Participant.id).join(Participant.site).where(func.lower(Participant.code) == code.lower(), in_scope(caller))
    return db.scalar(query)


def withdrawn_codes(db: Session, caller: Caller) -> frozenset[str]:
    """Return the codes of the withdrawn participants that the caller may read."""
    query = select(Participant.code).join(Participant.site).where(in_scope(caller), Participant.status == "withdrawn")
    return frozenset(db.scalars(query))


def find_participants(db: Session, caller: Caller, words: str, most: int) -> Sequence[Participant]:
    """Find participants whose code contains the words, by code."""
    query = select(Participant).join(Participant.site).options(joinedload(Participant.site))
    return db.scalars(query.where(_holds(Participant.code, words), in_scope(caller)).order_by(Participant.code).limit(most)).all()


def find_session(db: Session, caller: Caller, number: int, owner: int | None) -> Sequence[Any]:
    """Find a session by number, with participant, visit and day; limited to one participant if `owner` is given."""
    query = select(StudySession.id, Participant.code, Visit.number, Visit.date).join(StudySession.visit).join(Visit.participant)
    return db.execute(_within(query, caller, owner).where(StudySession.id == number)).all()


def find_policies(db: Session, caller: Caller, words: str, owner: int | None, most: int) -> Sequence[Any]:
    """Find policies whose name contains the words: number, name, kind, participant's code."""
    query = select(Policy.id, Policy.name, Policy.kind, Participant.code).join(Participant, Participant.id == Policy.participant_id)
    named = _within(query, caller, owner).where(_holds(Policy.name, words))
    return db.execute(named.order_by(Participant.code, Policy.name).limit(most)).all()


def find_jobs(db: Session, caller: Caller, words: str, kinds: Sequence[str], owner: int | None, most: int) -> Sequence[Any]:
    """Find jobs of these kinds, or whose number begins with the words, newest first: number, kind, status, time, participant."""
    query = select(Job.id, Job.kind, Job.status, Job.created_at, Participant.code).join(Participant, Participant.id == Job.participant_id)
    begins = Job.id.startswith(words.lower(), autoescape=True) if len(words) >= _FEWEST_OF_A_NUMBER else false()
    named = _within(query, caller, owner).where(begins | Job.kind.in_(kinds))
    return db.execute(named.order_by(Job.created_at.desc()).limit(most)).all()


_FEWEST_OF_A_NUMBER = 4
"""Characters of a job's number that are looked for; fewer would find many."""


def _within(query: Any, caller: Caller, owner: int | None) -> Any:
    scoped = query.join(Participant.site).where(in_scope(caller))
    return scoped if owner is None else scoped.where(Participant.id == owner)


def _holds(column: Any, words: str) -> Any:
    return column.icontains(words, autoescape=True)
