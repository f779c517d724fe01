"""REST route of what devices keep beside sessions."""

from __future__ import annotations

from fastapi import APIRouter

from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentParticipant
from app.study.recordings import repository
from app.study.recordings.history import history_of
from app.study.recordings.schemas import DeviceHistoryOut
from app.study.recordings.serializers import history_out

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/device-history")
def device_history(participant: CurrentParticipant, db: Db) -> list[DeviceHistoryOut]:
    """Trends, snapshots and surveys of spectra, therapy groups and events that the participant's devices told, the newest report first."""
    hidden = repository.sealed_days(db, participant.id)
    return [history_out(history_of(r, hidden)) for r in repository.histories(db, participant.id)]
