"""What somebody should do next for a participant, who may do it, and where: values; `app.overview.wording` has their sentences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from app.study.models import Participant

if TYPE_CHECKING:
    from app.overview.state import State


class Actor(StrEnum):
    """Whose turn it is."""

    CLINICIAN = "clinician"
    COORDINATOR = "coordinator"
    ENGINEER = "engineer"
    SERVICE = "service"


class Task(StrEnum):
    """What is to be done, in the order in which one thing waits for the other."""

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


def next_steps(participant: Participant, state: State) -> list[NextStep]:
    """Everything that is to be done for a participant, what others wait for first."""
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
