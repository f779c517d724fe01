"""HTML page of a participant's adverse events; the session page shows those of its session."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.templates import render
from app.study import repository as study_repository
from app.study.access import may
from app.study.adverse_events import repository, service
from app.study.adverse_events.deps import CurrentEvent
from app.study.adverse_events.schemas import AdverseEventChange, AdverseEventIn, ClearanceIn
from app.study.adverse_events.words import EVENT_KINDS, EVENT_SEVERITIES
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.participants import Participant

router = APIRouter()

_LABELS = {
    "kind": "What happened", "severity": "How bad", "serious": "Serious", "note": "Note", "session_id": "Session", "visit_id": "Visit",
    "reason": "Reason",
}  # fmt: skip


@router.get("/participants/{code}/adverse-events", dependencies=[ResultsViewed])
def adverse_events(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """All events of a participant, what waits for a clinician first, and a form for a new one."""
    return _page(request, participant, db, caller, {})


@router.post("/participants/{code}/adverse-events")
def add_adverse_event(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Write an event down."""
    typed = {name: str(values[name]) for name in AdverseEventIn.model_fields if name in values} | {
        "serious": str(values.get("serious", ""))
    }
    try:
        row = service.add_adverse_event(db, participant, parse(AdverseEventIn, typed, _LABELS), caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, participant, db, caller, typed, error)
    back = f"/sessions/{row.session_id}" if row.session_id else f"/participants/{participant.code}/adverse-events"
    return RedirectResponse(f"{back}?done=event", 303)


@router.post("/adverse-events/{event_id}/correction")
def change_adverse_event(request: Request, event: CurrentEvent, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Correct an event."""
    typed = {name: str(values[name]) for name in AdverseEventChange.model_fields if name in values}
    typed["serious"] = str(values.get("serious", ""))
    try:
        change = parse(AdverseEventChange, typed, _LABELS)
        service.change_adverse_event(db, event, change, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, event.participant, db, caller, typed, error, f"correct-{event.id}")
    return RedirectResponse(f"/participants/{event.participant.code}/adverse-events?done=corrected", 303)


@router.post("/adverse-events/{event_id}/clearance")
def clear_adverse_event(request: Request, event: CurrentEvent, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Clear a serious event, as a clinician."""
    typed = {"revision": str(values.get("revision", "")), "reason": str(values.get("reason", ""))}
    try:
        given = parse(ClearanceIn, typed, _LABELS)
        service.clear_adverse_event(db, event, given.revision, given.reason, caller)
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
    """The page; `form` is the one that was sent: `event` for a new one, `correct-3`, `clear-3`, as the ids of its fields begin."""
    found = repository.events_of_participant(db, participant.id)
    visits, _ = study_repository.visits(db, participant.id, 500, 0)
    page = render(
        request,
        "study/adverse_events.html",
        participant=participant,
        events=sorted(found, key=lambda e: (not e.blocks, -e.id)),
        policies={e.id: study_repository.policy_name(db, service.policy_of(e, caller)) for e in found},
        visits=visits,
        kinds=EVENT_KINDS,
        severities=EVENT_SEVERITIES,
        typed=typed,
        sent=form,
        remarks=field_notes(error, typed),
        may_add=may(caller, can.WRITE_QOC, participant),
        may_write=may(caller, can.WRITE_STUDY, participant),
        may_clear=may(caller, can.CLEAR_EVENT, participant),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
