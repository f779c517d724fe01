"""HTML page of a participant's adverse events; the session page shows those of its session."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.schemas import PagingQuery, RowId, problems
from app.platform.web.templates import render
from app.study import adverse_events as adverse_events_rules
from app.study import repository as study_repository
from app.study.access import may
from app.study.adverse_event_types import (
    CHOICES,
    EVENT_KINDS,
    EVENT_SEVERITIES,
    AdverseEventChange,
    AdverseEventIn,
    AdverseEventOut,
    ClearanceIn,
)
from app.study.adverse_events import event_out
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.adverse_events import AdverseEvent
from app.tables.participants import Participant

# The adverse event that a path names, within what the caller may read.


def current_event(event_id: RowId, db: Db, caller: CurrentCaller) -> AdverseEvent:
    """Load the event that the path names."""
    return adverse_events_rules.event(db, event_id, caller)


CurrentEvent = Annotated[AdverseEvent, Depends(current_event)]


# REST routes of adverse events.

api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@api.get("/participants/{code}/adverse-events", dependencies=[ResultsViewed])
def list_adverse_events(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> list[AdverseEventOut]:
    """List a participant's adverse events in the order in which they were entered."""
    return [event_out(row, caller) for row in adverse_events_rules.events_of_participant(db, participant.id)]


@api.post("/participants/{code}/adverse-events", status_code=201, responses=problems(409))
def add_adverse_event(participant: CurrentParticipant, draft: AdverseEventIn, db: Db, caller: CurrentCaller) -> AdverseEventOut:
    """Write down what happened in a session, at a visit, or apart from both. Sent twice under one `entry_key`, it is one event."""
    row = adverse_events_rules.add_adverse_event(db, participant, draft, caller)
    return event_out(row, caller)


@api.put("/adverse-events/{event_id}", responses=problems(409))
def change_adverse_event(event: CurrentEvent, change: AdverseEventChange, db: Db, caller: CurrentCaller) -> AdverseEventOut:
    """Correct what is known of an event: a new revision, which no clinician has cleared yet."""
    row = adverse_events_rules.change_adverse_event(db, event, change, caller)
    return event_out(row, caller)


@api.post("/adverse-events/{event_id}/clearance", responses=problems(409))
def clear_adverse_event(event: CurrentEvent, given: ClearanceIn, db: Db, caller: CurrentCaller) -> AdverseEventOut:
    """State that a serious event does not count against what ran. Only for those who approve plans."""
    row = adverse_events_rules.clear_adverse_event(db, event, given.revision, given.reason, caller)
    return event_out(row, caller)


pages = APIRouter()

_LABELS = {
    "kind": "What happened", "severity": "How bad", "serious": "Serious", "note": "Note", "session_id": "Session", "visit_id": "Visit",
    "reason": "Reason", "occurred_at": "Began", "ended_at": "Ended", **{name: label for name, (label, _) in CHOICES.items()},
}  # fmt: skip


@pages.get("/adverse-events", dependencies=[ResultsViewed])
def all_adverse_events(request: Request, db: Db, caller: CurrentCaller, paging: PagingQuery) -> HTMLResponse:
    """Show the events of all participants, the newest first."""
    rows, total = adverse_events_rules.events_of_all(db, caller, paging.limit, paging.offset)
    page = render(
        request,
        "study/all_adverse_events.html",
        events=rows,
        total=total,
        paging=paging,
        kinds=EVENT_KINDS,
        severities=EVENT_SEVERITIES,
        choices=CHOICES,
    )
    return HTMLResponse(page)


@pages.get("/participants/{code}/adverse-events", dependencies=[ResultsViewed])
def adverse_events(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show all events of a participant, those that wait for a clinician first, and a form for a new one."""
    return _page(request, participant, db, caller, {})


@pages.post("/participants/{code}/adverse-events")
def add_adverse_event_by_form(
    request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues
) -> Response:
    """Write an event down."""
    typed = {name: str(values[name]) for name in AdverseEventIn.model_fields if name in values} | {
        "serious": str(values.get("serious", ""))
    }
    try:
        row = adverse_events_rules.add_adverse_event(db, participant, parse(AdverseEventIn, typed, _LABELS), caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, participant, db, caller, typed, error)
    back = f"/sessions/{row.session_id}" if row.session_id else f"/participants/{participant.code}/adverse-events"
    return RedirectResponse(f"{back}?done=event", 303)


@pages.post("/adverse-events/{event_id}/correction")
def change_adverse_event_by_form(request: Request, event: CurrentEvent, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Correct an event."""
    typed = {name: str(values[name]) for name in AdverseEventChange.model_fields if name in values}
    typed["serious"] = str(values.get("serious", ""))
    try:
        change = parse(AdverseEventChange, typed, _LABELS)
        adverse_events_rules.change_adverse_event(db, event, change, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, event.participant, db, caller, typed, error, f"correct-{event.id}")
    return RedirectResponse(f"/participants/{event.participant.code}/adverse-events?done=corrected", 303)


@pages.post("/adverse-events/{event_id}/clearance")
def clear_adverse_event_by_form(request: Request, event: CurrentEvent, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Clear a serious event, as a clinician."""
    typed = {"revision": str(values.get("revision", "")), "reason": str(values.get("reason", ""))}
    try:
        given = parse(ClearanceIn, typed, _LABELS)
        adverse_events_rules.clear_adverse_event(db, event, given.revision, given.reason, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, event.participant, db, caller, typed, error, f"clear-{event.id}")
    return RedirectResponse(f"/participants/{event.participant.code}/adverse-events?done=cleared", 303)


def _page(
    request: Request,
    participant: Participant,
    db: Session,
    caller: Caller,
    typed: dict[str, Any],
    error: BetaloopError | None = None,
    form: str = "event",
) -> HTMLResponse:
    """Render the page; `form` is the one that was sent: `event` for a new one, `correct-3`, `clear-3`, as the ids of its fields begin."""
    found = adverse_events_rules.events_of_participant(db, participant.id)
    visits, _ = study_repository.visits(db, participant.id, 500, 0)
    page = render(
        request,
        "study/adverse_events.html",
        participant=participant,
        events=sorted(found, key=lambda e: (not e.blocks, -e.id)),
        policies={e.id: study_repository.policy_name(db, adverse_events_rules.policy_of(e, caller)) for e in found},
        visits=visits,
        kinds=EVENT_KINDS,
        severities=EVENT_SEVERITIES,
        choices=CHOICES,
        typed=typed,
        sent=form,
        remarks=field_notes(error, typed),
        may_add=may(caller, can.WRITE_QOC, participant),
        may_write=may(caller, can.WRITE_STUDY, participant),
        may_clear=may(caller, can.CLEAR_EVENT, participant),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
