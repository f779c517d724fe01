"""Forms of the doses on the page of a visit."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import RedirectResponse

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, parse
from app.platform.web.schemas import RowId, problems
from app.study import doses
from app.study.deps import CurrentVisit
from app.study.doses import DoseIn, DoseOut, DoseRemoval, dose_out
from app.study.routes.visits import shown_visit
from app.tables.visits import Dose, Visit

# The dose that a path names, within what the caller may read.


def current_dose(dose_id: RowId, db: Db, caller: CurrentCaller) -> tuple[Dose, Visit]:
    """Load the dose that the path names, and its visit."""
    return doses.dose_with_visit(db, dose_id, caller)


CurrentDose = Annotated[tuple[Dose, Visit], Depends(current_dose)]


# REST routes of doses.

api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@api.get("/visits/{visit_id}/doses")
def list_doses(visit: CurrentVisit) -> list[DoseOut]:
    """List doses of medication that bear on a visit, by time."""
    return [dose_out(row) for row in visit.doses]


@api.post("/visits/{visit_id}/doses", status_code=201, responses=problems(409))
def add_dose(visit: CurrentVisit, draft: DoseIn, db: Db, caller: CurrentCaller) -> DoseOut:
    """Write down a dose that was taken; the time since the last dose of the visit's sessions follows it."""
    row = doses.add_dose(db, visit, draft, caller)
    return dose_out(row)


@api.post("/doses/{dose_id}/removal", status_code=204, responses=problems(409))
def remove_dose(found: CurrentDose, change: DoseRemoval, db: Db, caller: CurrentCaller) -> None:
    """Take back a dose, with a reason."""
    doses.remove_dose(db, *found, change.reason, caller)


pages = APIRouter()

_LABELS = {"drug": "Drug", "mg": "Dose", "taken_at": "Taken at", "reason": "Reason"}


@pages.post("/visits/{visit_id}/doses")
def add_dose_by_form(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Write down a dose."""
    typed = {name: str(values.get(name, "")) for name in DoseIn.model_fields}
    try:
        doses.add_dose(db, visit, parse(DoseIn, typed, _LABELS), caller)
    except BetaloopError as error:
        db.rollback()
        return shown_visit(request, db, visit, caller, error=error, dose=typed, refused="dose")
    return RedirectResponse(f"/visits/{visit.id}?done=dose#doses", 303)


@pages.post("/doses/{dose_id}/removal")
def remove_dose_by_form(request: Request, found: CurrentDose, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Take back a dose."""
    visit = found[1]
    typed = {"reason": str(values.get("reason", ""))}
    try:
        given = parse(DoseRemoval, typed, _LABELS)
        doses.remove_dose(db, *found, given.reason, caller)
    except BetaloopError as error:
        db.rollback()
        return shown_visit(request, db, visit, caller, typed, error, refused=f"removal-{found[0].id}")
    return RedirectResponse(f"/visits/{visit.id}?done=dose_removed#doses", 303)
