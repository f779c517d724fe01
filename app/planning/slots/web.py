"""The page of planned against done."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.planning.plans import repository as plans
from app.planning.plans.visits import today
from app.planning.slots import service
from app.planning.slots.matching import DEVIATIONS, slots_summary
from app.planning.slots.serializers import SlotConfirmation, SlotsConfirmed, VisitComparisonOut, comparison_out
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues
from app.platform.web.schemas import problems
from app.platform.web.templates import render
from app.settings import get_settings
from app.study.access import may
from app.study.deps import CurrentVisit, VisitViewed
from app.tables.visits import Visit

# REST routes of planned against done.

api = APIRouter(tags=["planning"], responses=problems(401, 403, 404, 409, 422))


@api.get("/visits/{visit_id}/slots", dependencies=[VisitViewed])
def read_slots(visit: CurrentVisit, db: Db, caller: CurrentCaller) -> VisitComparisonOut:
    """Return the slots of the visit's signed plan with the sessions that fill them, planned against done against predicted."""
    return comparison_out(service.compare(db, visit, caller))


@api.post("/visits/{visit_id}/slots/confirm")
def confirm_slots(visit: CurrentVisit, confirmation: SlotConfirmation, db: Db, caller: CurrentCaller) -> SlotsConfirmed:
    """Put every found session into its slot and confirm those that wait for it, all or none."""
    notes = service.confirm(db, visit, caller, other_day=confirmation.other_day)
    return SlotsConfirmed(comparison=comparison_out(service.compare(db, visit, caller)), notes=notes)


pages = APIRouter()


@pages.get("/visits/{visit_id}/slots", dependencies=[VisitViewed])
def slots(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show each slot of the plan with its session, and what is missing."""
    return HTMLResponse(_page(request, db, visit, caller))


@pages.post("/visits/{visit_id}/slots/confirm")
def confirm(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> HTMLResponse:
    """Confirm all found sessions into their slots."""
    try:
        notes = service.confirm(db, visit, caller, other_day="other_day" in values)
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
        slots=_facts(found, caller),
        notes=notes,
        may_run=may(caller, can.RUN_JOBS, visit.participant) and any(r.confirmed for r in found.rows),
        may_upload=may(caller, can.UPLOAD, visit.participant) and not visit.locked,
        limit_mb=get_settings().upload_limit_mb,
        problem=error.problem(request.url.path) if error else None,
    )


def facts(db: Session, visit: Visit, caller: Caller) -> dict[str, Any] | None:
    """Build planned against done for the page of a visit, as `planning/_slots.html` takes it; None where no plan is signed."""
    plan = plans.live_plan(db, visit.id)
    if plan is None or plan.status != "approved":
        return None
    return _facts(service.compare(db, visit, caller), caller)


def _facts(found: service.Comparison, caller: Caller) -> dict[str, Any]:
    shown, visit = comparison_out(found), found.view.visit
    due = found.found > 0 or (visit.date is not None and visit.date < today())  # before that nothing can be there
    return {
        "found": shown,
        "waiting": len(found.waiting),
        "asks_about_day": bool(found.asks_about_day),
        "due": due,
        "policies": {line.policy.id: line.policy.name for line in found.view.lines if line.policy},
        "summary": slots_summary(found.planned, shown.missing, due, found.carry_over),
        "deviation_words": DEVIATIONS,
        "may_confirm": may(caller, can.WRITE_STUDY, visit.participant) and not visit.locked,
    }
