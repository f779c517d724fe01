"""REST routes of planned against done."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.planning.slots import service
from app.planning.slots.schemas import SlotConfirmation, SlotsConfirmed, VisitComparisonOut
from app.planning.slots.serializers import comparison_out
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentVisit, VisitViewed

router = APIRouter(tags=["planning"], responses=problems(401, 403, 404, 409, 422))


@router.get("/visits/{visit_id}/slots", dependencies=[VisitViewed])
def read_slots(visit: CurrentVisit, db: Db, caller: CurrentCaller) -> VisitComparisonOut:
    """The slots of the visit's signed plan with the sessions that fill them, planned against done against predicted."""
    return comparison_out(service.compare(db, visit, caller))


@router.post("/visits/{visit_id}/slots/confirm")
def confirm_slots(visit: CurrentVisit, confirmation: SlotConfirmation, db: Db, caller: CurrentCaller) -> SlotsConfirmed:
    """Put every found session into its slot and confirm those that wait for it, all or none."""
    notes = service.confirm(db, visit, caller, other_day=confirmation.other_day)
    return SlotsConfirmed(comparison=comparison_out(service.compare(db, visit, caller)), notes=notes)
