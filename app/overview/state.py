"""Where every participant stands, and what somebody should do."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass, field

from sqlalchemy.orm import Session

from app.overview import repository
from app.platform.jobs.models import Job
from app.study.models import Participant

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
        ranking_job: the live job that will bring the first ranking; None where there is a ranking or no such job.
        attention: sentences with the page where the matter is put right.
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
    ranking_job: Job | None = None
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


def _study(db: Session, ids: list[int], found: dict[int, State], today: dt.date) -> None:
    for key, visits, last, coming in repository.visit_days(db, ids, today):
        found[key].visits, found[key].last_visit, found[key].next_visit = visits, last, coming
    for key, total, excluded, without, proposed, newest in repository.session_counts(db, ids):
        state = found[key]
        state.sessions, state.excluded, state.without_qoc, state.proposed, state.newest_session = total, excluded, without, proposed, newest


def _results(db: Session, ids: list[int], found: dict[int, State]) -> None:
    for key, total in repository.policy_counts(db, ids):
        found[key].policies = total
    for key, evaluated_at, snapshot_at in repository.evaluation_times(db, ids):
        found[key].evaluated_at, found[key].snapshot_at = evaluated_at, snapshot_at
    for key, status in repository.plan_statuses(db, ids):
        found[key].plan = status
    for owner, running, failed in repository.job_counts(db, ids):
        if owner is not None:
            found[owner].running, found[owner].failed = running, failed
    for job in repository.live_ranking_jobs(db, ids):
        if job.participant_id is not None and found[job.participant_id].evaluated_at is None:
            found[job.participant_id].ranking_job = job


def _n(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
