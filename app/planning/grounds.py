"""Reasons for and against planning a policy: verdicts of two rankings, and adverse events."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation import repository as evaluations
from app.evaluation.ranking.assessment import Assessment
from app.evaluation.ranking.decisions import Decided, findings_of
from app.evaluation.ranking.judged import judged
from app.evaluation.schemas import Decision
from app.study.adverse_events import Events, blocking_events, events_of_participant
from app.tables.evaluations import Evaluation
from app.tables.participants import Participant
from app.tables.plans import Plan

_STRICTEST_FIRST = ("unsafe", "likely_worse", "test_with_care")


@dataclass(frozen=True)
class Finding:
    """Verdicts and events of one policy, taken together: a plan follows the strictest of them.

    Attributes:
        `said`: verdicts of the ranking behind the plan, then of the newest one. Without either, that of a serious adverse event alone.
    """

    said: tuple[Decided, ...]

    @property
    def verdict(self) -> Decision:
        """The strictest; where none is strict, that of the ranking behind the plan."""
        verdicts = [decided.decision for decided in self.said]
        return next((strict for strict in _STRICTEST_FIRST if strict in verdicts), verdicts[0])

    @property
    def held_back(self) -> Decided | None:
        """The newest for which it is planned only with a clinician's stated reason; None where none asks for that."""
        return next((decided for decided in reversed(self.said) if decided.needs_override), None)

    @property
    def with_care(self) -> bool:
        """True where any verdict is a test with care."""
        return any(decided.decision == "test_with_care" for decided in self.said)

    @property
    def limit(self) -> float | None:
        """The highest of the lowest amplitudes of a test with care, fraction of cDBS; None where no verdict names one."""
        return max((decided.limit for decided in self.said if decided.limit is not None), default=None)


@dataclass(frozen=True)
class Grounds:
    """All that a participant's policies are planned by.

    Attributes:
        rankings: the one behind the plan, then the newest where it is another one; empty without any. events: as `events_against` gives
            them.
    """

    rankings: tuple[Assessment, ...]
    events: Events

    def of(self, policy_id: int) -> Finding | None:
        """Return the finding on a policy; None where nothing is known of it."""
        ranked = [one for ranking in self.rankings if (one := ranking.of(policy_id)) is not None]
        said = tuple(one.planned for one in ranked if one.planned is not None)
        if not said and policy_id in self.events:
            said = (Decided("unsafe", findings_of(self.events[policy_id])),)
        return Finding(said) if said else None


def grounds(db: Session, participant: Participant, evaluation: Evaluation | None) -> Grounds:
    """Collect what plans of a participant follow at present.

    A plan may rest on an older ranking, so that its predictions can be compared with the sessions. Its rules are no more lenient.

    Args:
        evaluation: that the plan rests on; None where there is none.
    """
    newest = evaluations.newest_evaluation(db, participant.id)
    counted = {e.id: e for e in (evaluation, newest) if e is not None}
    rankings = tuple(judged(db, participant, one).assessment for one in counted.values())
    return Grounds(rankings, events_against(db, participant))


def unanswered(plan: Plan, events: Events) -> Events:
    """Return, by policy of a plan, the events that keep it from being signed and run.

    An event is answered where the plan says why the policy is tested all the same, and was drafted after the event was last described. An
    earlier reason cannot be about that event.

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
    """Return by policy the serious events and stops that no clinician has cleared; of sealed visits too: a verdict depends on no reader."""
    return blocking_events(events_of_participant(db, participant.id), SYSTEM)
