"""HTML pages of visits."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.numbers import typed
from app.platform.web.forms import FormValues, confirmed, field_notes, parse
from app.platform.web.templates import Part, make_part, render
from app.settings import get_settings
from app.study import access, cdbs_amplitude, repository
from app.study import visits as entering
from app.study.access import may
from app.study.blinding import arm, may_know, visible_arm
from app.study.deps import CurrentParticipant, CurrentVisit, ResultsViewed, VisitViewed
from app.study.doses import DRUG_NAMES, dose_out, since_last_dose
from app.study.outcomes import service as outcomes
from app.study.outcomes import values as outcome_values
from app.study.recordings import history
from app.study.schemas import CdbsAmplitudeModel, VisitChange, VisitIn
from app.study.sessions import pages as session_pages
from app.study.sessions.contradictions import control_recording
from app.study.sessions.repository import policy_shares
from app.study.sessions.usable_steps import session_data
from app.study.settings_form import Shown, own_changes, reason_of
from app.study.traces import TracesOf, traces_of
from app.study.visits import blinded_page
from app.tables.participants import Hemisphere, Participant
from app.tables.sessions import StudySession
from app.tables.visits import Visit

# The form that corrects a visit: date, note, and the cDBS amplitude of each hemisphere and program.

SIDES = tuple(side.value for side in Hemisphere)
PROGRAMS = range(4)
_PLAIN = {"date": "Date", "note": "Note"}


def texts(visit: Visit) -> dict[str, str]:
    """Write the visit's values as the form shows them."""
    fields = {"date": visit.date.isoformat() if visit.date else "", "note": visit.note or ""}
    fields |= {f"cdbs_{side}_{program}": "" for program in PROGRAMS for side in SIDES}
    return fields | {f"cdbs_{a.hemisphere}_{a.program}": typed(a.amplitude_ma, 10) for a in visit.cdbs_amplitudes}


def labels(fields: Mapping[str, str]) -> dict[str, str]:
    """Return the labels of the form's fields."""
    return {name: _PLAIN.get(name) or _label(name) for name in fields}


def seen_values(values: Mapping[str, Any], present: Mapping[str, str]) -> dict[str, str]:
    """Return what the posted form had shown; a field that it does not contain is compared with the stored value."""
    return {name: posted(values).get(f"seen_{name}", text) for name, text in present.items()}


def posted(values: Mapping[str, Any]) -> dict[str, str]:
    """Read the posted fields; browsers send line breaks as two characters."""
    return {str(name): str(value).replace("\r\n", "\n") for name, value in values.items()}


def amplitudes(typed: Mapping[str, str], sure: Collection[str] = ()) -> list[CdbsAmplitudeModel]:
    """Read the amplitudes that a form states, `sure` being the fields that a person confirmed. Raises Invalid, naming the field."""
    return [_amplitude(n, text, n in sure) for n, text in typed.items() if n.startswith("cdbs_") and text.strip()]


def asked_about(question: Mapping[str, Any]) -> str:
    """Return the field of the correction form that a question about an amplitude belongs to."""
    return f"cdbs_{question['hemisphere']}_{question['program']}"


def change(present: Mapping[str, str], changed: Mapping[str, str], reason: str, sure: Collection[str] = ()) -> VisitChange:
    """Build the change of a visit that the form requests; `sure`: fields that a person confirmed.

    Raises:
        Invalid: no reason, or a field that cannot be read; names it.
    """
    if not reason:
        raise Invalid("A correction needs a reason.", "Say why the visit is corrected.")
    fields: dict[str, Any] = {name: changed[name] for name in _PLAIN if name in changed}
    draft = parse(VisitChange, fields | {"reason": reason}, _PLAIN)
    merged = {**present, **changed}
    if any(name.startswith("cdbs_") for name in changed):
        draft.cdbs_amplitudes = amplitudes(merged, sure)
    return draft


def last_editor(db: Session, visit: Visit) -> str:
    """Return who changed the visit last."""
    return repository.last_editor(db, "visit", visit.id)


def _amplitude(name: str, text: str, sure: bool) -> CdbsAmplitudeModel:
    side, program = _place(name)
    values = {"hemisphere": side, "program": program, "amplitude_ma": text, "sure": "yes" if sure else "no"}
    try:
        return parse(CdbsAmplitudeModel, values, {"amplitude_ma": _label(name)})
    except Invalid as error:
        raise Invalid(error.detail, error.hint, errors=[e | {"name": name} for e in error.extra["errors"]]) from error


def _place(name: str) -> tuple[str, str]:
    _, side, *program = name.split("_")
    return side, program[0] if program else "0"


def _label(name: str) -> str:
    side, program = _place(name)
    return f"cDBS amplitude, {side}" + (f", program {program}" if program != "0" else "")


pages = APIRouter()

_VISIT_LABELS = {"number": "Number", "date": "Date", "note": "Note", "amplitude_ma": "cDBS amplitude"}
_FIRST_PROGRAM = ("cdbs_left", "cdbs_right")


@pages.get("/participants/{code}/visits", dependencies=[ResultsViewed])
def visits(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show all visits of a participant with their sessions."""
    rows, _ = repository.visits(db, participant.id, 1000, 0)
    days = entering.days_of(rows, repository.sessions_for_lists(db, participant.id), caller)
    may_write = may(caller, can.WRITE_STUDY, participant)
    waiting = repository.proposals_of_participant(db, participant.id)
    return HTMLResponse(
        render(request, "study/visits/visits.html", participant=participant, days=days, waiting=waiting, may_write=may_write)
    )


@pages.get("/participants/{code}/visits/new")
def new_visit(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the form of a new visit; the number is the next one."""
    access.require(caller, can.WRITE_STUDY, participant)
    rows, _ = repository.visits(db, participant.id, 1000, 0)
    draft = {"number": str(max((v.number for v in rows), default=0) + 1), "date": datetime.now(UTC).date().isoformat(), "note": ""}
    return _visit_form(request, participant, draft)


@pages.post("/participants/{code}/visits")
def add_visit(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Add a visit."""
    typed = {str(k): str(v) for k, v in values.items()}
    try:
        draft = parse(VisitIn, {name: values.get(name, "") for name in ("number", "date", "note")}, _VISIT_LABELS)
        draft.cdbs_amplitudes = amplitudes({n: typed[n] for n in _FIRST_PROGRAM if n in typed}, confirmed(values, typed))
        visit = entering.add_visit(db, participant, draft, caller)
    except BetaloopError as error:
        db.rollback()
        return _visit_form(request, participant, typed, error)
    return RedirectResponse(f"/visits/{visit.id}?done=added", 303)


@pages.get("/visits/{visit_id}", dependencies=[VisitViewed])
def visit_page(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show one visit day: its sessions in order; to a blinded assessor without what gives the controllers away."""
    if not may_know(visit, caller) and not (visit.sealed and may(caller, can.READ_ARMS, visit.participant)):
        return blinded_page(request, db, visit, caller)
    return shown_visit(request, db, visit, caller)


@pages.post("/visits/{visit_id}/lock")
def lock_visit(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Sign the data of a visit as complete and close them, or open them again (`unlock`)."""
    unlock, reason = values.get("unlock") == "yes", str(values.get("lock_reason", ""))[:1000]
    try:
        if unlock:
            entering.unlock(db, visit, reason, caller)
        else:
            entering.lock(db, visit, reason, caller, str(values.get("password", "")), str(values.get("code", "")))
    except BetaloopError as error:
        db.rollback()
        return shown_visit(request, db, visit, caller, None, error, lock_reason=reason, refused="lock")
    return RedirectResponse(f"/visits/{visit.id}?done={'unlocked' if unlock else 'locked'}#lock", 303)


@pages.post("/visits/{visit_id}")
def change_visit(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Correct a visit's date, note or cDBS amplitudes."""
    present = Shown(1, texts(visit), last_editor(db, visit))
    seen = Shown(0, seen_values(values, present.fields), "")
    changes = own_changes(posted(values), "0", [seen, present], labels(present.fields))
    typed = changes.fields | {"reason": reason_of(values) or ""}
    try:
        access.require(caller, can.WRITE_STUDY, visit.participant)
        changes.refuse_conflicts()
        sure = confirmed(values, {**present.fields, **changes.fields})
        entering.change_visit(db, visit, change(present.fields, changes.fields, typed["reason"], sure), caller)
    except BetaloopError as error:
        db.rollback()
        return shown_visit(request, db, visit, caller, typed, error)
    return RedirectResponse(f"/visits/{visit.id}?done=corrected", 303)


def shown_visit(
    request: Request,
    db: Session,
    visit: Visit,
    caller: Caller,
    typed: dict[str, str] | None = None,
    error: BetaloopError | None = None,
    dose: dict[str, str] | None = None,
    lock_reason: str = "",
    refused: str = "",
) -> HTMLResponse:
    """Render the page of a visit; `typed`, `dose` and `lock_reason` are the content of a refused form of a correction, a dose or a lock.

    `refused` says which form `error` is about: `dose`, `removal-` with a dose's number (what was typed is in `typed`), `lock`; empty: the
    correction's.
    """
    sessions, _ = repository.sessions_of_visit(db, visit.id)
    told = may_know(visit, caller)  # else its plan is sealed: letters and outcomes, and what else reveals nothing of what ran
    ran = [(arm(s, caller).controller, history.of_recording(control_recording(s))) for s in sessions if s.segments and told]
    seen, traces = texts(visit), traces_of(db, sessions)
    page = render(
        request,
        "study/visits/visit.html",
        visit=visit,
        participant=visit.participant,
        rows=[_session_row(db, s, traces, caller) for s in sessions],
        told=told,
        latencies=history.by_controller(ran),
        shares=policy_shares(db, [s.id for s in sessions]) if told else {},
        slots=make_part(Part.SLOTS_OF_VISIT, db, visit, caller),
        may_upload=may(caller, can.UPLOAD, visit.participant) and not visit.locked,
        limit_mb=get_settings().upload_limit_mb,
        proposals=[s for s in repository.proposals_of_participant(db, visit.participant_id) if s.visit_id == visit.id],
        seen=seen,
        shorthand_ma=cdbs_amplitude.held_settings(visit, visit.participant.current_settings).cdbs_amplitude_ma,
        draft=seen | {"reason": ""} | ({} if refused else typed or {}),
        labels=labels(seen),
        may_write=may(caller, can.WRITE_STUDY, visit.participant),
        may_run=may(caller, can.RUN_JOBS, visit.participant),
        doses=[dose_out(row) for row in visit.doses],
        drugs=DRUG_NAMES,
        dose=dose,
        may_dose=may(caller, can.WRITE_STUDY, visit.participant) and visit.participant.status != access.WITHDRAWN and not visit.locked,
        may_lock=may(caller, can.LOCK_VISIT, visit.participant),
        lock_reason=lock_reason,
        lock_meaning=entering.MEANING,
        lock_signatures=entering.signatures_of_locks(db, visit),
        problem=error.problem(request.url.path) if error else None,
        refused=refused,
        removal_reason=(typed or {}).get("reason", "") if refused else "",
        remarks=field_notes(error, seen | (typed or {}) | (dose or {}), asked_about),
    )
    return HTMLResponse(page, error.status if error else 200)


def _session_row(db: Session, session: StudySession, traces: TracesOf, caller: Caller) -> dict[str, Any]:
    """Build a session's row of the visit's table; a session that does not fit the grid says why."""
    clashes = outcomes.disagreements(session, outcome_values.derive(db, session))
    row: dict[str, Any] = {"session": session, "arm": visible_arm(session, caller), "summary": None, "problem": "", "clashes": clashes}
    row["since"] = since_last_dose(session)
    if row["arm"] is None:
        return row
    try:
        row["summary"] = session_pages.summarise(session_data(db, session, traces))
    except BetaloopError as error:
        row["problem"] = error.detail
    return row


def _visit_form(request: Request, participant: Participant, draft: dict[str, str], error: BetaloopError | None = None) -> HTMLResponse:
    problem = error.problem(request.url.path) if error else None
    values = {"cdbs_left": "", "cdbs_right": "", "number": "", "date": "", "note": ""} | draft
    remarks = field_notes(error, values, lambda q: f"cdbs_{q['hemisphere']}")
    return HTMLResponse(
        render(request, "study/visits/visit_new.html", participant=participant, draft=values, problem=problem, remarks=remarks),
        error.status if error else 200,
    )
