"""What a policy is planned by: the verdict of the ranking behind the plan, and adverse events, with a ranking or without."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.models import Evaluation
from app.evaluation.ranking.assessment import Assessment
from app.evaluation.ranking.decisions import Decided
from app.evaluation.ranking.judged import judged
from app.planning.plans.models import Plan
from app.study.adverse_events.models import AdverseEvent
from app.study.adverse_events.repository import events_of_participant
from app.study.adverse_events.service import blocking_events
from app.study.models import Participant
from ml.ope.flags import Flag

Events = Mapping[int, tuple[AdverseEvent, ...]]
"""Serious adverse events that no clinician has cleared, by policy."""

HAPPENED = Decided("unsafe", (Flag("adverse_event"),))
"""The verdict on a policy under which something serious happened, where no ranking says so."""


@dataclass(frozen=True)
class Grounds:
    """All that a participant's policies are planned by.

    Attributes:
        ranking: the one behind the plan; None without one. events: as `events_against` gives them.
    """

    ranking: Assessment | None
    events: Events

    def of(self, policy_id: int) -> Decided | None:
        """What is said of a policy; None where nothing is known of it."""
        one = self.ranking.of(policy_id) if self.ranking is not None else None
        decided = one.decided if one is not None else None
        return HAPPENED if decided is None and policy_id in self.events else decided


def grounds(db: Session, participant: Participant, evaluation: Evaluation | None) -> Grounds:
    """What plans of a participant go by now.

    Args:
        evaluation: that the plan rests on; None where there is none.
    """
    ranking = judged(db, participant, evaluation).assessment if evaluation is not None else None
    return Grounds(ranking, events_against(db, participant))


def unanswered(plan: Plan, events: Events) -> Events:
    """By policy of a plan, the events that keep it from being signed and run.

    An event is answered where the plan says why the policy is tested all the same, and was drafted after the event was last described: who
    gave a reason before cannot have meant it.

    Args:
        events: as `events_against` gives them.
    """
    found = {}
    for item in plan.items:
        open_ones = tuple(
            event for event in events.get(item.policy_id or 0, ()) if not item.override_reason or event.now.created_at >= plan.created_at
        )
        if item.policy_id is not None and open_ones:
            found[item.policy_id] = open_ones
    return found


def events_against(db: Session, participant: Participant) -> Events:
    """By policy, serious adverse events that no clinician has cleared; those of sealed visits too, as a verdict depends on no reader."""
    return blocking_events(events_of_participant(db, participant.id), SYSTEM)
