"""REST routes of adverse events."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.adverse_events import repository, service
from app.study.adverse_events.deps import CurrentEvent
from app.study.adverse_events.schemas import AdverseEventChange, AdverseEventIn, AdverseEventOut, ClearanceIn
from app.study.adverse_events.serializers import event_out
from app.study.deps import CurrentParticipant, ResultsViewed

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/adverse-events", dependencies=[ResultsViewed])
def list_adverse_events(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> list[AdverseEventOut]:
    """A participant's adverse events in the order in which they were entered."""
    return [event_out(row, caller) for row in repository.events_of_participant(db, participant.id)]


@router.post("/participants/{code}/adverse-events", status_code=201, responses=problems(409))
def add_adverse_event(participant: CurrentParticipant, draft: AdverseEventIn, db: Db, caller: CurrentCaller) -> AdverseEventOut:
    """Write down what happened in a session, at a visit, or apart from both. Sent twice under one `entry_key`, it is one event."""
    row = service.add_adverse_event(db, participant, draft, caller)
    return event_out(row, caller)


@router.put("/adverse-events/{event_id}", responses=problems(409))
def change_adverse_event(event: CurrentEvent, change: AdverseEventChange, db: Db, caller: CurrentCaller) -> AdverseEventOut:
    """Correct what is known of an event: a new revision, which no clinician has cleared yet."""
    row = service.change_adverse_event(db, event, change, caller)
    return event_out(row, caller)


@router.post("/adverse-events/{event_id}/clearance", responses=problems(409))
def clear_adverse_event(event: CurrentEvent, given: ClearanceIn, db: Db, caller: CurrentCaller) -> AdverseEventOut:
    """State that a serious event does not stand against what ran. Those who approve plans alone."""
    row = service.clear_adverse_event(db, event, given.revision, given.reason, caller)
    return event_out(row, caller)
