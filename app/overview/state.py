"""State of every participant, and what is to be done."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from sqlalchemy.orm import Session

from app.overview import repository
from app.planning.slots import repository as slots
from app.platform.numbers import counted
from app.tables.jobs import Job
from app.tables.participants import Participant

# Tasks for a participant, who may do them, and where: values; `state` says what is due, `wording` the sentences.


class Actor(StrEnum):
    """Person whose turn it is."""

    CLINICIAN = "clinician"
    COORDINATOR = "coordinator"
    ENGINEER = "engineer"
    SERVICE = "service"


class Task(StrEnum):
    """Task, in the order in which one thing waits for the other."""

    ADD_VISIT = "add_visit"
    STATE_AMPLITUDE = "state_amplitude"
    UPLOAD = "upload"
    SEND_LOGS = "send_logs"
    CONFIRM = "confirm"
    ENTER_QOCS = "enter_qocs"
    SET_THRESHOLD = "set_threshold"
    WAIT_FOR_RANKING = "wait_for_ranking"
    RANK = "rank"
    OPEN_KEY = "open_key"
    RANK_AGAIN = "rank_again"
    TRAIN_NEXT = "train_next"
    DRAFT_PLAN = "draft_plan"
    APPROVE_PLAN = "approve_plan"
    LOOK_AT_FAILED = "look_at_failed"


@dataclass(frozen=True)
class NextStep:
    """One thing to do.

    Attributes:
        task: what. actor: whose turn it is. url: where it is done. count: of sessions or jobs that it is about; 0 where it counts nothing.
        blocks_visit: whether the next visit waits for it.
        urgent: whether the participant is marked for it; what is merely next is not.
    """

    task: Task
    actor: Actor
    url: str
    count: int = 0
    blocks_visit: bool = True
    urgent: bool = True


# How far the visits with a signed plan are: sessions planned, done, and those whose logs are missing. What is to be done: `state`.


@dataclass(frozen=True)
class VisitProgress:
    """One visit with a signed plan.

    Attributes:
        planned: sessions of the plan. `held`: those that a confirmed session fills.
        logs_missing: those that none fills although the day is past; 0 before it, of a visit without a date, and of a locked one.
        tested: those filled that ran a policy; 0 while the key is sealed, which hides it. sealed: whether it is.
    """

    visit_id: int
    number: int
    date: dt.date | None
    planned: int
    held: int
    logs_missing: int
    tested: int
    sealed: bool = False


def visit_progress(db: Session, participant_ids: Sequence[int], today: dt.date) -> dict[int, list[VisitProgress]]:
    """Return by participant its visits with a signed plan, by number; participants without one have none.

    Plans of versions that kept no limits have no slots to fill and are ignored.
    """
    found: dict[int, list[VisitProgress]] = {i: [] for i in participant_ids}
    for row in slots.slots_filled(db, participant_ids):
        past = row.date is not None and row.date < today
        missing = row.slots - row.filled if past and not row.locked else 0
        tested = 0 if row.sealed else row.tested
        progress = VisitProgress(row.visit_id, row.number, row.date, row.slots, row.filled, missing, tested, row.sealed)
        found[row.participant_id].append(progress)
    return found


PHASES = (("I", "Collect"), ("II", "Learn"), ("III", "Evaluate"), ("IV", "Plan"))


@dataclass
class State:
    """State of a participant.

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
        next_planned: whether the next visit has an approved plan or a draft.
        planned_visits: how far the visits with a signed plan are, by number.
        steps: what is to be done, what others wait for first.
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
    next_planned: bool = False
    planned_visits: list[VisitProgress] = field(default_factory=list)
    steps: list[NextStep] = field(default_factory=list)

    @property
    def phase(self) -> int:
        """Index into PHASES of what comes next."""
        if not self.sessions:
            return 0
        if not self.policies or (self.evaluated_at and self.grown):
            return 1
        return 2 if self.evaluated_at is None else 3

    @property
    def attention(self) -> list[NextStep]:
        """Steps that need attention, beyond being merely the next thing to do."""
        return [s for s in self.steps if s.urgent]

    @property
    def blocked_by(self) -> NextStep | None:
        """Step that the next visit waits for first; None where it can take place."""
        return next((s for s in self.steps if s.blocks_visit), None)

    @property
    def last_planned(self) -> VisitProgress | None:
        """The last visit with a signed plan up to today, else the next one; None without any."""
        begun = [v for v in self.planned_visits if v.held or v.logs_missing]
        return begun[-1] if begun else next(iter(self.planned_visits), None)

    @property
    def grown(self) -> bool:
        """True where sessions came after the last evaluation's snapshot."""
        return bool(self.snapshot_at and self.newest_session and self.newest_session > self.snapshot_at)


def states(db: Session, participants: Sequence[Participant], today: dt.date) -> dict[int, State]:
    """Determine the state of each participant, by row number."""
    ids = [p.id for p in participants]
    found = {i: State() for i in ids}
    _study(db, ids, found, today)
    _results(db, ids, found)
    for key, visits in visit_progress(db, ids, today).items():
        found[key].planned_visits = visits
    for participant in participants:
        found[participant.id].steps = next_steps(participant, found[participant.id])
    return found


def next_steps(participant: Participant, state: State) -> list[NextStep]:
    """List everything that is to be done for a participant, what others wait for first."""
    return list(_steps(participant, state))


def _steps(participant: Participant, state: State) -> Iterator[NextStep]:
    home, settings = f"/participants/{participant.code}", participant.current_settings
    clinician, engineer = Actor.CLINICIAN, Actor.ENGINEER
    if not state.visits:
        yield NextStep(Task.ADD_VISIT, clinician, f"{home}/visits/new")
    if settings.cdbs_amplitude_ma is None and not state.sessions:
        yield NextStep(Task.STATE_AMPLITUDE, clinician, f"{home}/settings")
    if state.visits and not state.sessions:
        yield NextStep(Task.UPLOAD, clinician, f"{home}/upload", blocks_visit=False)
    for visit in state.planned_visits:
        if visit.logs_missing:
            yield NextStep(Task.SEND_LOGS, Actor.COORDINATOR, f"/visits/{visit.visit_id}/slots", visit.logs_missing, blocks_visit=False)
    if state.proposed:
        yield NextStep(Task.CONFIRM, clinician, f"{home}/proposals", state.proposed)
    if state.without_qoc:
        yield NextStep(Task.ENTER_QOCS, clinician, f"{home}/visits", state.without_qoc)
    if settings.xi_beta is None:
        yield NextStep(Task.SET_THRESHOLD, clinician, f"{home}/settings", blocks_visit=bool(state.sessions))
    if state.ranking_job is not None:
        yield NextStep(Task.WAIT_FOR_RANKING, Actor.SERVICE, f"/jobs/{state.ranking_job.id}", urgent=False)
    elif state.sessions and state.evaluated_at is None:
        yield NextStep(Task.RANK, engineer, f"{home}/jobs", urgent=False)
    for visit in state.planned_visits:
        if visit.sealed and visit.held == visit.planned:
            yield NextStep(Task.OPEN_KEY, clinician, f"/visits/{visit.visit_id}/plan", blocks_visit=False)
    if state.grown and any(visit.tested for visit in state.planned_visits):
        yield NextStep(Task.TRAIN_NEXT, engineer, f"{home}/next-generation")
    elif state.grown:
        yield NextStep(Task.RANK_AGAIN, engineer, f"{home}/jobs")
    if state.plan == "draft":
        yield NextStep(Task.APPROVE_PLAN, clinician, f"{home}/plans")
    elif state.next_visit is not None and state.evaluated_at is not None and not state.next_planned:
        yield NextStep(Task.DRAFT_PLAN, clinician, f"{home}/ranking", urgent=False)
    if state.failed:
        yield NextStep(Task.LOOK_AT_FAILED, engineer, f"{home}/jobs", state.failed, blocks_visit=False)


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
    for key, status, day in repository.plan_statuses(db, ids):
        found[key].plan = status
        found[key].next_planned |= day is not None and day == found[key].next_visit
    for owner, running, failed in repository.job_counts(db, ids):
        if owner is not None:
            found[owner].running, found[owner].failed = running, failed
    for job in repository.live_ranking_jobs(db, ids):
        if job.participant_id is not None and found[job.participant_id].evaluated_at is None:
            found[job.participant_id].ranking_job = job


# Sentences of the pages that join phases.

ACTORS = {
    Actor.CLINICIAN: "Clinician",
    Actor.COORDINATOR: "Coordinator",
    Actor.ENGINEER: "Engineer",
    Actor.SERVICE: "Running automatically",
}

_TASKS: dict[Task, str | Callable[[int], str]] = {
    Task.ADD_VISIT: "No visit yet",
    Task.STATE_AMPLITUDE: "No cDBS amplitude in the settings",
    Task.UPLOAD: "No session yet",
    Task.SEND_LOGS: lambda n: f"{counted(n, 'planned session')} without a log",
    Task.CONFIRM: lambda n: f"{counted(n, 'session')} to confirm",
    Task.ENTER_QOCS: lambda n: f"{counted(n, 'session')} without outcomes",
    Task.SET_THRESHOLD: "Beta threshold is not set; jobs cannot start",
    Task.WAIT_FOR_RANKING: "The first ranking is being made",
    Task.RANK: "No ranking yet: start the pipeline",
    Task.OPEN_KEY: "A blinded visit is held, and nothing learns from it: open the key of its plan",
    Task.RANK_AGAIN: "New sessions since the last ranking, which is out of date",
    Task.TRAIN_NEXT: "New sessions since the last ranking: train the next generation",
    Task.DRAFT_PLAN: "No plan for this visit yet",
    Task.APPROVE_PLAN: "A visit plan waits for approval",
    Task.LOOK_AT_FAILED: lambda n: f"{counted(n, 'job')} failed in the last 7 days",
}


def what(step: NextStep) -> str:
    """Describe what is to be done."""
    said = _TASKS[step.task]
    return said if isinstance(said, str) else said(step.count)


def progress(visit: VisitProgress) -> str:
    """Describe how far a visit with a signed plan is."""
    missing = f", {counted(visit.logs_missing, 'log')} missing" if visit.logs_missing else ""
    return f"Visit {visit.number}: {visit.held} of {counted(visit.planned, 'planned session')} held{missing}"


def in_days(days: int) -> str:
    """Describe how far ahead a day is."""
    return {0: "today", 1: "tomorrow"}.get(days, f"in {days} days")
