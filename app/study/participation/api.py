"""REST route of taking part."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentParticipant
from app.study.participation import service
from app.study.participation.schemas import StatusChange
from app.study.schemas import ParticipantOut
from app.study.serializers import participant_out

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@router.patch("/participants/{code}")
def change_status(participant: CurrentParticipant, change: StatusChange, db: Db, caller: CurrentCaller) -> ParticipantOut:
    """Say that a participant has completed the study, has withdrawn, or takes part again; a withdrawal cancels running jobs."""
    service.change_status(db, participant, change, caller)
    return participant_out(participant)
