"""HTML pages of visit plans."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import Field
from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.evaluation import verdict_wording
from app.evaluation import wording as evaluation_wording
from app.evaluation.ranking.answer import Answer, Row
from app.evaluation.ranking.assessment import cdbs_amplitude_now
from app.evaluation.ranking.judged import Judged
from app.evaluation.ranking.service import current
from app.evaluation.wording import method_name, sentence
from app.learning import repository as learning
from app.learning.models import Policy
from app.planning import wording
from app.planning.plans import key, repository, service
from app.planning.plans.designs import offered
from app.planning.plans.schemas import HeldIn, Id, LimitIn, Move, PlanIn, PlanOptions
from app.planning.plans.service import rules_of
from app.planning.plans.sign_off import MEANING
from app.planning.plans.suggested import Held, held_in, suggested
from app.planning.plans.view import PlanView, read_plan, shown
from app.planning.plans.visits import remove_visit, today, visit_for_draft
from app.planning.protocol.schedule import most_policies, total_minutes
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid, NotFound
from app.platform.web.forms import FormValues, parse
from app.platform.web.schemas import Int, Model, PagingQuery
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant, CurrentVisit
from app.study.models import Controller, Participant, Visit
from app.study.service import may, require
from ml.designs import LOW_AMPLITUDE
from ml.ope.posterior.further_sessions import MOST_HELD, Place

router = APIRouter()

EARLY_RANDOM_SESSIONS = 3
"""What the form offers while a participant has no policy: with a cDBS session first, an hour."""

LABELS = {
    "minutes_per_session": "Minutes per session",
    "total_minutes": "Minutes of the visit",
    "washout_minutes": "Washout",
    "random_sessions": "Random sessions",
    "no_dbs_minutes": "No-DBS session",
    "repeats": "Sessions of each policy",
    "order": "Order",
    "break_minutes": "Break",
    "starts_at": "First session at",
    "hemisphere": "Side that the controllers set",
    "min_ma": "Lowest amplitude",
    "max_ma": "Highest amplitude",
    "ramp_ma_per_s": "Fastest change",
    "note": "Note on the sheet",
    "min_fraction": "Lowest amplitude, share of cDBS",
    "reason": "Why the approved plan is replaced",
    "amplitude_ma": "Held near, mA",
    "amplitude_fraction": "Held near, share of cDBS",
    "sessions": "Sessions held near it",
    "visit_id": "Visit",
    "visit_number": "Number of the new visit",
    "visit_date": "Date of the new visit",
}


UNITS = ("amplitude_ma", "amplitude_fraction")
"""In which the form names amplitudes."""
MOST_ROWS = 5


class VisitChoice(Model):
    """Which visit a draft is for; with neither id nor number the first open visit or a new one with the next number."""

    visit_id: Id | None = None
    visit_number: Int | None = Field(None, ge=1, le=10_000)
    visit_date: dt.date | None = None


@router.get("/visits/{visit_id}/plan")
def plan(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """The visit day to scale, its sessions, approval, and the form for a new draft."""
    return HTMLResponse(_page(request, db, visit, caller))


@router.post("/visits/{visit_id}/plan")
def draft(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Draft the visit from the form."""
    try:
        service.draft_plan(db, visit, _draft(values), caller)
        db.commit()
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
        db.commit()
    except BetaloopError as error:
        db.rollback()
        return HTMLResponse(_page(request, db, visit, caller, error), error.status)
    return RedirectResponse(f"/visits/{visit.id}/plan?done=approved", 303)


@router.get("/participants/{code}/plans")
def plans(request: Request, participant: CurrentParticipant, db: Db, paging: PagingQuery) -> HTMLResponse:
    """All plans of a participant, and the visits that may still be planned."""
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
    wanted, plan_in = parse(VisitChoice, {k: "" if v == "new" else v for k, v in values.items()}, LABELS), _draft(values)
    if wanted.visit_id is None and wanted.visit_number is None:
        return _choose_visit(request, db, participant, caller, values)
    visit = visit_for_draft(db, participant, wanted.visit_id, wanted.visit_number, wanted.visit_date, caller)
    service.draft_plan(db, visit, plan_in, caller)
    db.commit()
    return RedirectResponse(f"/visits/{visit.id}/plan?done=drafted", 303)


@router.post("/visits/{visit_id}/plan/move")
def move(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Move a tested session of the draft up or down, by a button or by dragging it."""
    try:
        service.reorder(db, visit, parse(Move, values, LABELS), caller)
        db.commit()
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
            key.give_reason(db, visit, found, caller, reason)
        else:
            key.open_key(db, visit, found, caller, reason, emergency="emergency" in values)
        db.commit()
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
        db.commit()
    except BetaloopError as error:
        db.rollback()
        return HTMLResponse(_page(request, db, visit, caller, error), error.status)
    return RedirectResponse(f"/participants/{code}/plans?done=removed", 303)


def _choose_visit(request: Request, db: Session, participant: Participant, caller: Caller, values: FormData) -> HTMLResponse:
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
        next_number=repository.next_visit_number(db, participant.id),
    )
    return HTMLResponse(page)


def _draft(values: FormData) -> PlanIn:
    """The form as the API's type."""
    ids = [str(v) for v in values.getlist("policy_ids")]
    wrong = [i for i in ids if not (i.isdecimal() and 0 < int(i) < 2**31)]
    if wrong:
        raise Invalid(f"'{wrong[0]}' is no policy.", "Choose policies of the list.")
    if len(ids) > 20:
        raise Invalid(f"{len(ids)} policies are chosen; a visit takes 20 at most.", "Tick fewer.")
    options = parse(PlanOptions, values, LABELS)
    reasons, lowest = ({i: str(values.get(f"{name}_{i}", "")).strip() for i in ids} for name in ("override", "limit"))
    overrides = [{"policy_id": int(i), "reason": text} for i, text in reasons.items() if text]
    limits = [parse(LimitIn, {"policy_id": i, "min_fraction": text}, LABELS) for i, text in lowest.items() if text]
    return PlanIn.model_validate(
        {"policy_ids": [int(i) for i in ids], "overrides": overrides, "limits": limits, "held": _held_of(values)}
        | options.model_dump(exclude_unset=True)
    )


def _page(
    request: Request, db: Session, visit: Visit, caller: Caller, error: BetaloopError | None = None, values: FormData | None = None
) -> str:
    participant = visit.participant
    try:
        full: PlanView | None = read_plan(db, visit, caller)
    except NotFound:
        full = None
    view = shown(full) if full else None
    try:
        found: Judged | None = current(db, participant, caller)
    except NotFound:
        found = None
    defaults = rules_of(PlanOptions())
    choices = _choices(db, participant, found.answer if found is not None else None)
    form = _form_values(full, values, choices)
    slots, settings = most_policies(defaults), participant.current_settings
    place = Place(settings.lower_bound, round(60 * defaults.session_minutes / settings.period_s), settings.period_s)
    suggestions = suggested(found, slots)
    return render(
        request,
        "planning/plan.html",
        visit=visit,
        participant=participant,
        site=participant.site,
        view=view,
        ranking=found,
        standing_names=verdict_wording.STANDING_NAMES,
        plainly=verdict_wording.plainly,
        amplitude=evaluation_wording.amplitude,
        signed=evaluation_wording.signed,
        chance=evaluation_wording.chance,
        typed=values or {},
        may_override=may(caller, can.APPROVE_PLAN, participant),
        in_words=sentence,
        design_name=wording.design_name,
        design_words=wording.design_words,
        bound_words=wording.bound_words,
        schedule_words=wording.schedule_words,
        leave_at_once=wording.LEAVE_AT_ONCE,
        limits_ma=wording.limits_ma,
        meaning=MEANING,
        plan_method=method_name(view.evaluation.default_method) if view and view.evaluation else "",
        choices=choices,
        suggestions=[(s.policy, wording.suggestion(s.why, first=k == 0)) for k, s in enumerate(suggestions)],
        held_rows=_held_rows(values, held_in(found, slots - len(suggestions), place), place.lower_bound, cdbs_amplitude_now(participant)),
        holding=wording.holding,
        low_amplitude=LOW_AMPLITUDE,
        most_held=MOST_HELD,
        outlook=request.app.state.outlook(db, participant, caller),
        form_values=form,
        chosen=_chosen(full if view is full else None, values),
        movable=_movable(view),
        order_words=wording.order_words,
        session_name=wording.session_name,
        orders=wording.ORDER_NAMES,
        warning_words=wording.warning,
        problem=error.problem(request.url.path) if error else None,
        fit=[(n, total_minutes(n, defaults)) for n in range(1, most_policies(defaults) + 1)],
        defaults=defaults,
    )


@dataclass(frozen=True)
class Choice:
    """A policy that may be planned, and what the ranking says of it.

    Attributes:
        row: None for what no ranking holds. twins: policies that do the same by the ranking, such as its students.
    """

    policy: Policy
    row: Row | None
    twins: tuple[Policy, ...]


def _choices(db: Session, participant: Participant, answered: Answer | None) -> list[Choice]:
    """Behaviours that may be planned, what to test first; policies that no ranking holds come last."""
    rows = answered.everyone() if answered is not None else {}
    places = {i: k for k, i in enumerate(rows)}
    policies = sorted(learning.candidates(db, participant.id), key=lambda p: (places.get(p.id, len(places)), p.id))
    known = {p.id for p in policies}
    heads = {p.id: rows[p.id].one.policy.id if p.id in rows and rows[p.id].one.policy.id in known else p.id for p in policies}
    twins = {head: tuple(p for p in policies if heads[p.id] == head and p.id != head) for head in heads.values()}
    return [Choice(p, rows.get(p.id), twins[p.id]) for p in policies if heads[p.id] == p.id]


def _chosen(view: PlanView | None, values: FormData | None) -> Sequence[int]:
    if values is not None:
        return [int(v) for v in map(str, values.getlist("policy_ids")) if v.isdecimal()]
    return [line.item.policy_id for line in view.lines if line.item.policy_id] if view else []


def _movable(view: PlanView | None) -> list[int]:
    """Positions of the tested sessions of a draft, in order."""
    if view is None or view.plan.status != "draft":
        return []
    return [i.item.position for i in view.lines if i.item.controller not in (Controller.CDBS, Controller.NO_DBS)]


def _form_values(view: PlanView | None, values: FormData | None, choices: Sequence[Any]) -> dict[str, Any]:
    """What the form shows: what was sent, else the present plan's note, else the defaults."""
    shown: dict[str, Any] = {k: f"{v:g}" if isinstance(v, float) else v for k, v in PlanOptions().model_dump().items()}
    if view:
        shown["note"] = view.plan.note
    elif not choices:
        shown["random_sessions"] = EARLY_RANDOM_SESSIONS
    if values is not None:
        shown |= {name: str(values[name]) for name in shown if name in values} | {
            "no_dbs": "no_dbs" in values,
            "blinded": "blinded" in values,
        }
    return shown


@dataclass(frozen=True)
class HeldRow:
    """One row of the form.

    Attributes:
        unit: of `UNITS`. amplitude, sessions: as they stand in the fields. why: what the sessions would tell; None of a free row.
    """

    unit: str
    amplitude: str
    sessions: str
    why: Held | None = None


def _held_of(values: FormData) -> list[HeldIn]:
    """The sessions that the form asks for; a row without a number of sessions asks for none.

    Raises:
        Invalid: what no row of the form sends, or values outside their range.
    """
    units, amplitudes, sessions = ([str(v).strip() for v in values.getlist(f"held_{name}")] for name in ("unit", "amplitude", "sessions"))
    if not len(units) == len(amplitudes) == len(sessions) <= MOST_ROWS or any(unit not in UNITS for unit in units):
        raise Invalid("The held sessions are not those of the form.", "Load the page again.")
    rows = zip(units, amplitudes, sessions, strict=True)
    return [parse(HeldIn, {unit: amplitude, "sessions": number}, LABELS) for unit, amplitude, number in rows if number not in ("", "0")]


def _held_rows(values: FormData | None, holds: Sequence[Held], lower_bound: float, cdbs_ma: float | None) -> list[HeldRow]:
    """What the form shows: what is suggested, no session asked for, and a free row; what was sent where it was refused."""
    unit = "amplitude_ma" if cdbs_ma is not None else "amplitude_fraction"
    rows = [HeldRow(unit, offered(h.hold.fraction, lower_bound, cdbs_ma), "", h) for h in holds]
    rows = [*rows[: MOST_ROWS - 1], HeldRow(unit, "", "")]
    sent = [[str(v) for v in values.getlist(f"held_{name}")] for name in ("amplitude", "sessions")] if values is not None else [[], []]
    if len(sent[0]) != len(rows) or len(sent[1]) != len(rows):
        return rows
    return [HeldRow(row.unit, sent[0][i], sent[1][i], row.why) for i, row in enumerate(rows)]
