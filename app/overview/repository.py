"""Queries that join phases: what the overview says of every participant, in a handful of statements whatever their number; the trail."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import Row, false, func, select
from sqlalchemy.orm import Session, joinedload

from app.accounts.permissions import Caller
from app.evaluation.schemas import RANKING_KINDS
from app.study.repository import in_scope
from app.tables.evaluations import EstimateRow, Evaluation
from app.tables.jobs import Job, JobStatus
from app.tables.learning import BufferSnapshot, Policy
from app.tables.outcomes import QocRevision
from app.tables.participants import Participant
from app.tables.plans import Plan
from app.tables.sessions import StudySession
from app.tables.visits import Visit


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
