"""The page of planned against done."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.planning import wording
from app.planning.slots import service
from app.planning.slots.serializers import comparison_out
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues
from app.platform.web.templates import render
from app.study.deps import CurrentVisit
from app.study.models import Visit
from app.study.service import may

router = APIRouter()


@router.get("/visits/{visit_id}/slots")
def slots(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Each slot of the plan with its session, and what is missing."""
    return HTMLResponse(_page(request, db, visit, caller))


@router.post("/visits/{visit_id}/slots/confirm")
def confirm(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> HTMLResponse:
    """Confirm all found sessions into their slots."""
    try:
        notes = service.confirm(db, visit, caller, other_day="other_day" in values)
        db.commit()
    except BetaloopError as error:
        db.rollback()
        return HTMLResponse(_page(request, db, visit, caller, error), error.status)
    return HTMLResponse(_page(request, db, visit, caller, notes=notes))


def _page(
    request: Request, db: Session, visit: Visit, caller: Caller, error: BetaloopError | None = None, notes: list[str] | None = None
) -> str:
    found = service.compare(db, visit, caller)
    return render(
        request,
        "planning/slots.html",
        visit=visit,
        participant=visit.participant,
        found=comparison_out(found),
        waiting=len(found.waiting),
        asks_about_day=bool(found.asks_about_day),
        summary=wording.slots_summary(found.planned, comparison_out(found).missing),
        deviation_words=wording.DEVIATIONS,
        notes=notes,
        may_run=may(caller, can.RUN_JOBS, visit.participant) and any(r.confirmed for r in found.rows),
        may_confirm=may(caller, can.WRITE_STUDY, visit.participant),
        problem=error.problem(request.url.path) if error else None,
    )
