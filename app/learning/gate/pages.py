"""The page of the replay buffer's gate."""

from __future__ import annotations

from collections.abc import Mapping

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.learning.gate import service as gates
from app.learning.schemas import GateChange
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.templates import render
from app.study import repository as study_repository
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.participants import Participant

router = APIRouter()

LABELS = {"reason": "Reason", "choice": "Decision"}


@router.get("/participants/{code}/buffer-gate", dependencies=[ResultsViewed])
def gate_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show whether sessions of learned policies enter the replay buffer, the tests behind it, and the form to decide otherwise."""
    return _page(request, participant, db, caller)


@router.post("/participants/{code}/buffer-gate")
def decide_gate(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Decide on the gate with a reason."""
    typed = {name: str(values.get(name, "")) for name in LABELS}
    try:
        change = parse(GateChange, typed, LABELS)
        gates.decide(db, participant, change.choice, change.reason, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, participant, db, caller, error, typed)
    return RedirectResponse(f"/participants/{participant.code}/buffer-gate?done=decided", 303)


def _page(
    request: Request,
    participant: Participant,
    db: Session,
    caller: Caller,
    error: BetaloopError | None = None,
    typed: Mapping[str, str] | None = None,
) -> HTMLResponse:
    site = participant.site
    gate = gates.gate(db, participant, study_repository.sessions_of_participant(db, participant.id))
    page = render(
        request,
        "learning/gate.html",
        participant=participant,
        gate=gate,
        grounds=gates.gate_grounds(gate),
        alpha=gates.ALPHA,
        typed=typed or dict.fromkeys(LABELS, ""),
        may_decide=caller.may(can.DECIDE_GATE, site.study_id, site.id),
        remarks=field_notes(error, typed or {}),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
