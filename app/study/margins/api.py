"""REST routes of margins and levels."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentParticipant
from app.study.margins import service
from app.study.margins.schemas import MarginsChange, MarginsLockIn, MarginsLockOut, MarginsOut
from app.study.margins.serializers import lock_rows

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/margins")
def list_margins(participant: CurrentParticipant) -> list[MarginsOut]:
    """All versions of the margins within which an outcome counts as no worse than under cDBS, oldest first; the last one holds."""
    return [MarginsOut.model_validate(version) for version in participant.margins]


@router.put("/participants/{code}/margins", responses=problems(409))
def change_margins(participant: CurrentParticipant, change: MarginsChange, db: Db, caller: CurrentCaller) -> MarginsOut:
    """Change margins or levels: a new version; members left out keep their value. Those who approve plans alone."""
    row = service.change_margins(db, participant, change.margins, change.reason, caller)
    return MarginsOut.model_validate(row)


@router.get("/participants/{code}/margins/locks")
def list_margins_locks(participant: CurrentParticipant, db: Db) -> list[MarginsLockOut]:
    """When margins were locked, oldest first; the last one holds. Verdicts confirm with sessions recorded after it alone."""
    return lock_rows(db, participant)


@router.post("/participants/{code}/margins/locks", status_code=201, responses=problems(409, 429))
def lock_margins(participant: CurrentParticipant, wanted: MarginsLockIn, db: Db, caller: CurrentCaller) -> MarginsLockOut:
    """Lock the present margins before the sessions that they will judge, signed over their values. Those who approve plans alone."""
    service.lock_margins(db, participant, wanted.version, wanted.reason, caller, wanted.password, wanted.code)
    return lock_rows(db, participant)[-1]
