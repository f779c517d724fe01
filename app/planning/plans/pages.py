"""HTML pages of visit plans."""

from __future__ import annotations

import datetime as dt

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import Field
from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.evaluation import wording as evaluation_wording
from app.evaluation.ranking import verdict_wording
from app.evaluation.wording import method_name, sentence
from app.planning.plans import draft_form, repository, service, sign_off, wording
from app.planning.plans.schemas import Id, Move
from app.planning.plans.sign_off import MEANING
from app.planning.plans.view import PlanView, read_plan, shown, standings_of
from app.planning.plans.visits import remove_visit, today, visit_for_draft
from app.platform.database import Db
from app.platform.errors import BetaloopError, NotFound
from app.platform.web.forms import FormValues, field_notes, parse, renamed
from app.platform.web.schemas import Int, Model, PagingQuery
from app.platform.web.templates import Part, make_part, render
from app.study.access import may, require
from app.study.deps import CurrentParticipant, CurrentVisit, VisitViewed
from app.tables.participants import Participant
from app.tables.sessions import Controller
from app.tables.visits import Visit

router = APIRouter()


class VisitChoice(Model):
    """Visit that a draft is for; with neither id nor number the first open visit or a new one with the next number."""

    visit_id: Id | None = None
    visit_number: Int | None = Field(None, ge=1, le=10_000)
    visit_date: dt.date | None = None


@router.get("/visits/{visit_id}/plan", dependencies=[VisitViewed])
def plan(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, replace: str = "") -> HTMLResponse:
    """Show the visit day to scale, its sessions, approval, and the form for a new draft; of a signed plan only to replace it."""
    return HTMLResponse(_page(request, db, visit, caller, replacing=replace == "yes"))


@router.post("/visits/{visit_id}/plan")
def draft(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Draft the visit from the form."""
    try:
        service.draft_plan(db, visit, draft_form.draft_of(values), caller)
    except BetaloopError as error:
        db.rollback()
        return HTMLResponse(_page(request, db, visit, caller, error, values), error.status)
    return RedirectResponse(f"/visits/{visit.id}/plan?done=drafted", 303)


@router.post("/visits/{visit_id}/plan/approve")
def approve(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Sign the draft that the page showed."""
    try:
        shown = str(values.get("plan_id", ""))
        password, code = str(values.get("password", "")), str(values.get("code", ""))
        service.approve_plan(db, visit, caller, password, int(shown) if shown.isdecimal() else None, code)
    except BetaloopError as error:
        db.rollback()
        return HTMLResponse(_page(request, db, visit, caller, error), error.status)
    return RedirectResponse(f"/visits/{visit.id}/plan?done=approved", 303)


@router.get("/participants/{code}/plans")
def plans(request: Request, participant: CurrentParticipant, db: Db, paging: PagingQuery) -> HTMLResponse:
    """Show all plans of a participant, and the visits that may still be planned."""
    rows, total = repository.plans(db, participant.id, paging.limit, paging.offset)
    page = render(
        request,
        "planning/plans.html",
        participant=participant,
        rows=rows,
        total=total,
        paging=paging,
        open_visits=repository.open_visits(db, participant.id, today()),
        next_number=repository.next_visit_number(db, participant.id),
    )
    return HTMLResponse(page)


@router.post("/participants/{code}/plan/draft")
def draft_from_ranking(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Draft a visit from the policies ticked in the ranking; where no visit is chosen, ask which."""
    chosen: Visit | None = None
    try:
        wanted = parse(VisitChoice, {k: "" if v == "new" else v for k, v in values.items()}, draft_form.LABELS)
        if wanted.visit_id is None and wanted.visit_number is None:
            return _choose_visit(request, db, participant, caller, values)
        visit = visit_for_draft(db, participant, wanted.visit_id, wanted.visit_number, wanted.visit_date, caller)
        chosen = visit if wanted.visit_id is not None else None
        service.draft_plan(db, visit, draft_form.draft_of(values), caller)
    except BetaloopError as error:
        db.rollback()
        if chosen is None:
            return _choose_visit(request, db, participant, caller, values, renamed(error, {"number": "visit_number"}))
        return HTMLResponse(_page(request, db, chosen, caller, error, values), error.status)
    return RedirectResponse(f"/visits/{visit.id}/plan?done=drafted", 303)


@router.post("/visits/{visit_id}/plan/move")
def move(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Move a tested session of the draft up or down, by a button or by dragging it."""
    try:
        service.reorder(db, visit, parse(Move, values, draft_form.LABELS), caller)
    except BetaloopError as error:
        db.rollback()
        return HTMLResponse(_page(request, db, visit, caller, error), error.status)
    return RedirectResponse(f"/visits/{visit.id}/plan?done=moved#order", 303)


@router.post("/visits/{visit_id}/plan/key")
def open_key(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Open the key of a blinded plan, or give the reason afterwards."""
    reason = str(values.get("reason", ""))
    try:
        found = read_plan(db, visit, caller).plan
        if found.key_opened_at is not None:
            sign_off.give_reason(db, visit, found, caller, reason)
        else:
            sign_off.open_key(db, visit, found, caller, reason, emergency="emergency" in values)
    except BetaloopError as error:
        db.rollback()
        return HTMLResponse(_page(request, db, visit, caller, error), error.status)
    return RedirectResponse(f"/visits/{visit.id}/plan?done=opened", 303)


@router.post("/visits/{visit_id}/remove")
def remove(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Remove a visit in which nothing was done."""
    code = visit.participant.code
    try:
        remove_visit(db, visit, str(values.get("reason", "")), caller)
    except BetaloopError as error:
        db.rollback()
        return HTMLResponse(_page(request, db, visit, caller, error), error.status)
    return RedirectResponse(f"/participants/{code}/plans?done=removed", 303)


def _choose_visit(
    request: Request, db: Session, participant: Participant, caller: Caller, values: FormData, error: BetaloopError | None = None
) -> HTMLResponse:
    """Ask which visit the ticked policies are for; what was sent goes on with the answer."""
    require(caller, can.DRAFT_PLAN, participant)
    sent = [(name, str(value)) for name, value in values.multi_items() if name not in VisitChoice.model_fields]
    page = render(
        request,
        "planning/choose_visit.html",
        participant=participant,
        sent=sent,
        open_visits=repository.open_visits(db, participant.id, today()),
        plans={plan.visit_id: plan for plan, _ in repository.plans(db, participant.id, 500, 0)[0] if plan.status != "superseded"},
        number=str(values.get("visit_number", "")) or repository.next_visit_number(db, participant.id),
        day=str(values.get("visit_date", "")),
        remarks=field_notes(error, dict.fromkeys(VisitChoice.model_fields, "")),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)


def _page(
    request: Request,
    db: Session,
    visit: Visit,
    caller: Caller,
    error: BetaloopError | None = None,
    values: FormData | None = None,
    *,
    replacing: bool = False,
) -> str:
    participant = visit.participant
    try:
        full: PlanView | None = read_plan(db, visit, caller)
    except NotFound:
        full = None
    view = shown(full) if full else None
    signed = view is not None and view.plan.status == "approved"
    may_approve = may(caller, can.SIGN_PLAN, participant)
    # a signed plan is there to be run: policies are offered, and named next to one whose key is sealed, only on request
    drafting = may(caller, can.DRAFT_PLAN, participant) and (not signed or (may_approve and (replacing or values is not None)))
    return render(
        request,
        "planning/plan.html",
        visit=visit,
        participant=participant,
        site=participant.site,
        view=view,
        standing_names=verdict_wording.STANDING_NAMES,
        plainly=verdict_wording.plainly,
        amplitude=evaluation_wording.amplitude,
        signed=evaluation_wording.signed,
        chance=evaluation_wording.chance,
        in_words=sentence,
        design_name=wording.design_name,
        design_words=wording.design_words,
        bound_words=wording.bound_words,
        schedule_words=wording.schedule_words,
        leave_at_once=wording.LEAVE_AT_ONCE,
        limits_ma=wording.limits_ma,
        meaning=MEANING,
        plan_method=method_name(view.evaluation.default_method) if view and view.evaluation else "",
        movable=_movable(view),
        order_words=wording.order_words,
        session_name=wording.session_name,
        standings=standings_of(db, view, caller) if view else [],
        warnings=[text for _, text in wording.plain_warnings(view.warnings)] if view else [],
        method_notes=wording.method_notes(view.warnings) if view else [],
        remarks=field_notes(error, dict.fromkeys(values, "")) if values is not None else {},
        signing_notes={name: note for name, note in field_notes(error, {}).items() if name in ("password", "code")},
        problem=error.problem(request.url.path) if error else None,
        may_override=may_approve,
        drafting=drafting,
        **(
            draft_form.shown_of(db, visit, caller, full, values) | {"outlook": make_part(Part.OUTLOOK, db, participant, caller)}
            if drafting
            else {}
        ),
    )


def _movable(view: PlanView | None) -> list[int]:
    """List positions of the tested sessions of a draft, in order."""
    if view is None or view.plan.status != "draft":
        return []
    return [i.item.position for i in view.lines if i.item.controller not in (Controller.CDBS, Controller.NO_DBS)]
