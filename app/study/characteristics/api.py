"""REST routes of characteristics."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.characteristics import service
from app.study.characteristics.schemas import CharacteristicsChange, CharacteristicsOut
from app.study.deps import CurrentParticipant

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/characteristics")
def list_characteristics(participant: CurrentParticipant) -> list[CharacteristicsOut]:
    """All versions of a participant's characteristics, oldest first; the last one holds."""
    return [CharacteristicsOut.model_validate(row) for row in participant.characteristics]


@router.put("/participants/{code}/characteristics", responses=problems(409))
def change_characteristics(
    participant: CurrentParticipant, change: CharacteristicsChange, db: Db, caller: CurrentCaller
) -> CharacteristicsOut:
    """State characteristics as a whole: a new version, or the present one where nothing differs."""
    row = service.change_characteristics(db, participant, change.version, change.characteristics, change.reason, caller)
    return CharacteristicsOut.model_validate(row)
