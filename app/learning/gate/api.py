"""REST routes of the replay buffer's gate."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.learning.gate import service as gates
from app.learning.schemas import GateChange, GateOut
from app.learning.serializers import gate_out
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study import repository as study_repository
from app.study.deps import CurrentParticipant, ResultsViewed

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/buffer-gate", dependencies=[ResultsViewed])
def read_gate(participant: CurrentParticipant, db: Db) -> GateOut:
    """Whether sessions of learned policies may enter the replay buffer, with the tests behind it."""
    return gate_out(gates.gate(db, participant, study_repository.sessions_of_participant(db, participant.id)))


@router.post("/participants/{code}/buffer-gate", status_code=201)
def decide_gate(participant: CurrentParticipant, change: GateChange, db: Db, caller: CurrentCaller) -> GateOut:
    """Decide on the gate with a reason: open it, shut it, or follow the tests again. Clinicians alone."""
    gates.decide(db, participant, change.choice, change.reason, caller)
    return read_gate(participant, db)
