"""REST routes of the replay buffer's gate."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.learning.gate import service as gates
from app.learning.schemas import GateChange, GateDecisionOut, GateOut, QocTestOut
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study import repository as study_repository
from app.study.deps import CurrentParticipant, ResultsViewed

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


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


@router.get("/participants/{code}/buffer-gate", dependencies=[ResultsViewed])
def read_gate(participant: CurrentParticipant, db: Db) -> GateOut:
    """Whether sessions of learned policies may enter the replay buffer, with the tests behind it."""
    return gate_out(gates.gate(db, participant, study_repository.sessions_of_participant(db, participant.id)))


@router.post("/participants/{code}/buffer-gate", status_code=201)
def decide_gate(participant: CurrentParticipant, change: GateChange, db: Db, caller: CurrentCaller) -> GateOut:
    """Decide on the gate with a reason: open it, shut it, or follow the tests again. Clinicians alone."""
    gates.decide(db, participant, change.choice, change.reason, caller)
    return read_gate(participant, db)
