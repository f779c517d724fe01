"""Queries that join phases: what the overview says of every participant, in a handful of statements whatever their number."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass, field

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from app.evaluation.models import Evaluation
from app.learning.models import BufferSnapshot, Policy
from app.planning.plans.models import Plan
from app.platform.audit import AuditEvent
from app.platform.jobs.models import Job, JobStatus
from app.study.models import Participant, QocRevision, StudySession, Visit

PHASES = (("I", "Collect"), ("II", "Learn"), ("III", "Evaluate"), ("IV", "Plan"))


@dataclass
class State:
    """Where a participant stands.

    Attributes:
        sessions, excluded, without_qoc: counts of confirmed sessions; the last one of those that are not excluded.
        proposed: sessions that wait for a person's confirmation and count nowhere yet.
        newest_session: when the last session was entered; None without any.
        last_visit, next_visit: the last one up to today, and the first from today on.
        policies: trained, distilled and external ones that are not retired.
        evaluated_at, snapshot_at: of the last evaluation, and of the buffer snapshot that it used.
        plan: status of the plan of the latest visit that has one.
        running, failed: jobs; the latter of the last 7 days.
        attention: sentences with the page where the matter is mended.
    """

    sessions: int = 0
    excluded: int = 0
    without_qoc: int = 0
    proposed: int = 0
    newest_session: dt.datetime | None = None
    visits: int = 0
    last_visit: dt.date | None = None
    next_visit: dt.date | None = None
    policies: int = 0
    evaluated_at: dt.datetime | None = None
    snapshot_at: dt.datetime | None = None
    plan: str | None = None
    running: int = 0
    failed: int = 0
    attention: list[tuple[str, str]] = field(default_factory=list)

    @property
    def phase(self) -> int:
        """Index into PHASES of what comes next."""
        if not self.sessions:
            return 0
        if not self.policies or (self.evaluated_at and self.grown):
            return 1
        return 2 if self.evaluated_at is None else 3

    @property
    def grown(self) -> bool:
        """Whether sessions came after the last evaluation's snapshot."""
        return bool(self.snapshot_at and self.newest_session and self.newest_session > self.snapshot_at)


def states(db: Session, participants: Sequence[Participant], today: dt.date) -> dict[int, State]:
    """Where each participant stands, by row number."""
    ids = [p.id for p in participants]
    found = {i: State() for i in ids}
    _study(db, ids, found, today)
    _results(db, ids, found)
    for participant in participants:
        found[participant.id].attention = attention(participant, found[participant.id])
    return found


def attention(participant: Participant, state: State) -> list[tuple[str, str]]:
    """What somebody should do, as sentences with the page where it is done."""
    home, settings = f"/participants/{participant.code}", participant.current_settings
    todo: list[tuple[str, str]] = []
    if settings.xi_beta is None:
        todo.append(("Beta threshold ξβ is not set; jobs cannot start", f"{home}/settings"))
    if settings.cdbs_amplitude_ma is None and state.sessions == 0:
        todo.append(("No cDBS amplitude in the settings", f"{home}/settings"))
    if not state.visits:
        todo.append(("No visit yet", f"{home}/visits/new"))
    elif not state.sessions:
        todo.append(("No session yet", f"{home}/upload"))
    if state.without_qoc:
        todo.append((f"{_n(state.without_qoc, 'session')} without QoCs", f"{home}/visits"))
    if state.proposed:
        todo.append((f"{_n(state.proposed, 'session')} to confirm", f"{home}/proposals"))
    if state.grown:
        todo.append(("New sessions since the last ranking; it is stale", f"{home}/ranking"))
    if state.plan == "draft":
        todo.append(("A visit plan waits for approval", f"{home}/plans"))
    if state.failed:
        todo.append((f"{_n(state.failed, 'job')} failed in the last 7 days", f"{home}/jobs"))
    return todo


def audit_events(db: Session, entity: str, entity_id: str, actor: str, limit: int, offset: int) -> tuple[Sequence[AuditEvent], int]:
    """A page of the audit trail, newest first, and how many rows match; empty filters match all."""
    query: Select[AuditEvent] = select(AuditEvent)
    for column, wanted in ((AuditEvent.entity, entity), (AuditEvent.entity_id, entity_id), (AuditEvent.actor, actor)):
        if wanted:
            query = query.where(column == wanted)
    total = db.scalar(select(func.count()).select_from(query.subquery())) or 0
    return db.scalars(query.order_by(AuditEvent.id.desc()).limit(limit).offset(offset)).all(), total


def _study(db: Session, ids: list[int], found: dict[int, State], today: dt.date) -> None:
    visits = (
        select(
            Visit.participant_id,
            func.count(),
            func.max(Visit.date).filter(Visit.date <= today),
            func.min(Visit.date).filter(Visit.date >= today),
        )
        .where(Visit.participant_id.in_(ids))
        .group_by(Visit.participant_id)
    )
    for key, visits_n, last, coming in db.execute(visits):
        found[key].visits, found[key].last_visit, found[key].next_visit = visits_n, last, coming
    confirmed = StudySession.status == "confirmed"
    counts = confirmed & StudySession.excluded_reason.is_(None)
    has_qoc = select(QocRevision.id).where(QocRevision.session_id == StudySession.id).exists()
    sessions = (
        select(
            Visit.participant_id,
            func.count().filter(confirmed),
            func.count().filter(confirmed & ~counts),
            func.count().filter(counts & ~has_qoc),
            func.count().filter(~confirmed),
            func.max(StudySession.created_at).filter(confirmed),
        )
        .join(Visit, Visit.id == StudySession.visit_id)
        .where(Visit.participant_id.in_(ids))
        .group_by(Visit.participant_id)
    )
    for key, total, excluded, without, proposed, newest in db.execute(sessions):
        state = found[key]
        state.sessions, state.excluded, state.without_qoc, state.proposed, state.newest_session = total, excluded, without, proposed, newest


def _results(db: Session, ids: list[int], found: dict[int, State]) -> None:
    policies = select(Policy.participant_id, func.count()).where(Policy.participant_id.in_(ids), Policy.retired_reason.is_(None))
    for key, total in db.execute(policies.where(Policy.kind != "baseline").group_by(Policy.participant_id)):
        found[key].policies = total
    evaluations = (
        select(Evaluation.participant_id, Evaluation.created_at, BufferSnapshot.created_at)
        .join(BufferSnapshot, BufferSnapshot.id == Evaluation.snapshot_id)
        .where(Evaluation.participant_id.in_(ids))
        .order_by(Evaluation.id)
    )
    for key, evaluated_at, snapshot_at in db.execute(evaluations):
        found[key].evaluated_at, found[key].snapshot_at = evaluated_at, snapshot_at
    plans = select(Visit.participant_id, Plan.status).join(Visit, Visit.id == Plan.visit_id)
    for key, status in db.execute(plans.where(Visit.participant_id.in_(ids), Plan.status != "superseded").order_by(Visit.number)):
        found[key].plan = status
    live = Job.status.in_([JobStatus.QUEUED, JobStatus.RUNNING])
    lately = (Job.status == JobStatus.FAILED) & (Job.finished_at > func.now() - dt.timedelta(days=7))
    jobs = select(Job.participant_id, func.count().filter(live), func.count().filter(lately)).where(Job.participant_id.in_(ids))
    for owner, running, failed in db.execute(jobs.group_by(Job.participant_id)):
        if owner is not None:
            found[owner].running, found[owner].failed = running, failed


def _n(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
