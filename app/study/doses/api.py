"""REST routes of doses."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentVisit
from app.study.doses import service
from app.study.doses.deps import CurrentDose
from app.study.doses.schemas import DoseIn, DoseOut, DoseRemoval
from app.study.doses.serializers import dose_out

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@router.get("/visits/{visit_id}/doses")
def list_doses(visit: CurrentVisit) -> list[DoseOut]:
    """Doses of medication that bear on a visit, by time."""
    return [dose_out(row) for row in visit.doses]


@router.post("/visits/{visit_id}/doses", status_code=201, responses=problems(409))
def add_dose(visit: CurrentVisit, draft: DoseIn, db: Db, caller: CurrentCaller) -> DoseOut:
    """Write down a dose that was taken; the time since the last dose of the visit's sessions follows it."""
    row = service.add_dose(db, visit, draft, caller)
    return dose_out(row)


@router.post("/doses/{dose_id}/removal", status_code=204, responses=problems(409))
def remove_dose(found: CurrentDose, change: DoseRemoval, db: Db, caller: CurrentCaller) -> None:
    """Take back a dose, with a reason."""
    service.remove_dose(db, *found, change.reason, caller)
