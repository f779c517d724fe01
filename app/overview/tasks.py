"""What somebody may have to do for a participant, who may do it, and where: values; `state` says what is due, `wording` the sentences."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


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
