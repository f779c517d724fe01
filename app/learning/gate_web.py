"""The page of the replay buffer's gate."""

from __future__ import annotations

from collections.abc import Mapping

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.learning import gate as gates
from app.learning.schemas import GateChange, GateDecisionOut, GateOut, QocTestOut
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.schemas import problems
from app.platform.web.templates import render
from app.study import repository as study_repository
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.participants import Participant

# REST routes of the replay buffer's gate.

api = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


def gate_out(found: gates.Gate) -> GateOut:
    """Convert the gate for the API."""
    decision = found.decision
    return GateOut(
        open=found.is_open,
        grounds=gates.gate_grounds(found),
        opened_by_test=found.opened_by_test,
        tests=[
            QocTestOut(
                qoc=t.field,
                note=gates.gate_test_note(t),
                **{name: getattr(t, name) for name in QocTestOut.model_fields if name not in ("qoc", "note")},
            )
            for t in found.tests
        ],
        decision=None
        if decision is None
        else GateDecisionOut(
            choice=decision.choice, reason=decision.reason, created_at=decision.created_at, created_by=decision.created_by
        ),
    )


@api.get("/participants/{code}/buffer-gate", dependencies=[ResultsViewed])
def read_gate(participant: CurrentParticipant, db: Db) -> GateOut:
    """Return whether sessions of learned policies may enter the replay buffer, with the tests behind it."""
    return gate_out(gates.gate(db, participant, study_repository.sessions_of_participant(db, participant.id)))


@api.post("/participants/{code}/buffer-gate", status_code=201)
def decide_gate(participant: CurrentParticipant, change: GateChange, db: Db, caller: CurrentCaller) -> GateOut:
    """Decide on the gate with a reason: open it, shut it, or follow the tests again. Clinicians alone."""
    gates.decide(db, participant, change.choice, change.reason, caller)
    return read_gate(participant, db)


pages = APIRouter()

LABELS = {"reason": "Reason", "choice": "Decision"}


@pages.get("/participants/{code}/buffer-gate", dependencies=[ResultsViewed])
def gate_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show whether sessions of learned policies enter the replay buffer, the tests behind it, and the form to decide otherwise."""
    return _page(request, participant, db, caller)


@pages.post("/participants/{code}/buffer-gate")
def decide_gate_by_form(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
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
