"""Forms of the doses on the page of a visit."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, parse
from app.study.deps import CurrentVisit
from app.study.doses import service
from app.study.doses.deps import CurrentDose
from app.study.doses.schemas import DoseIn, DoseRemoval
from app.study.visits.pages import shown_visit

router = APIRouter()

_LABELS = {"drug": "Drug", "mg": "Dose", "taken_at": "Taken at", "reason": "Reason"}


@router.post("/visits/{visit_id}/doses")
def add_dose(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Write down a dose."""
    typed = {name: str(values.get(name, "")) for name in DoseIn.model_fields}
    try:
        service.add_dose(db, visit, parse(DoseIn, typed, _LABELS), caller)
    except BetaloopError as error:
        db.rollback()
        return shown_visit(request, db, visit, caller, error=error, dose=typed, refused="dose")
    return RedirectResponse(f"/visits/{visit.id}?done=dose#doses", 303)


@router.post("/doses/{dose_id}/removal")
def remove_dose(request: Request, found: CurrentDose, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Take back a dose."""
    visit = found[1]
    typed = {"reason": str(values.get("reason", ""))}
    try:
        given = parse(DoseRemoval, typed, _LABELS)
        service.remove_dose(db, *found, given.reason, caller)
    except BetaloopError as error:
        db.rollback()
        return shown_visit(request, db, visit, caller, typed, error, refused=f"removal-{found[0].id}")
    return RedirectResponse(f"/visits/{visit.id}?done=dose_removed#doses", 303)
