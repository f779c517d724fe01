"""HTML pages of proposed sessions: look, correct, confirm, cut, drop; and grasp files that wait for their session."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.ingest import repository, wording
from app.ingest.deps import CurrentProposal
from app.ingest.proposals import clocks
from app.ingest.proposals import service as proposals
from app.ingest.proposals.clocks import ClockIn
from app.ingest.proposals.forms import (
    FIELDS,
    HIDDEN,
    OWN,
    ProposalForm,
    as_change,
    as_parts,
    is_clocked,
    own_texts,
    texts,
    thumbnail,
    typed_own,
    typed_parts,
)
from app.ingest.proposals.visit_of_recording import add_visit_of_recording, visit_to_add
from app.ingest.uploads import service
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid, about
from app.platform.web.forms import FormValues, field_notes, parse, renamed
from app.platform.web.schemas import RowId
from app.platform.web.templates import render
from app.study import access
from app.study import repository as study
from app.study.blinding import CONTROLLER_NAMES, may_know
from app.study.deps import CurrentParticipant
from app.study.recordings import amplitude_sources
from app.study.recordings.amplitude_sources import AmplitudeChoice
from app.study.recordings.facts import clock_words, unknown_clock
from app.study.sessions import designs
from app.study.sessions import pages as session_pages
from app.study.sessions.charts import control_chart
from app.study.sessions.contradictions import contradictions, control_recording
from app.study.sessions.stimulation import has_markers, open_questions
from app.study.sessions.usable_steps import SessionData, session_data, usable_steps
from app.study.sessions.wording import drawn_words, sentences
from app.study.traces import control_programs
from app.tables.participants import Participant
from app.tables.sessions import StudySession
from app.tables.uploads import SessionProposal
from app.tables.visits import Visit

router = APIRouter()

DONE = {v: v for v in ("visit", "amplitude", "clock")} | {"discard": "dropped", "split": "cut", "confirm": "confirmed"}
"""What the page says was done, by the verb of the pressed button."""

SHOWN = 40
"""Proposals on one page; the next ones follow when these are decided."""


@router.get("/participants/{code}/proposals")
def proposals_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, confirmed: str = "") -> HTMLResponse:
    """Show all proposals of a participant in one form; what was just confirmed is listed with its contradictions."""
    return _page(request, db, participant, caller, confirmed=[int(i) for i in confirmed.split(",") if i.isdecimal() and len(i) < 10])


@router.get("/proposals/{session_id}")
def proposal_page(request: Request, session: CurrentProposal, db: Db, caller: CurrentCaller) -> Response:
    """Show one proposal with its traces; a confirmed one has a page as a session."""
    if session.status != "proposed":
        return RedirectResponse(f"/sessions/{session.id}", 303)
    return _page(request, db, session.visit.participant, caller, only=session)


@router.post("/participants/{code}/proposals")
def decide(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Do what the pressed button says to its proposal; corrections typed into the others are saved too."""
    access.require(caller, can.WRITE_STUDY, participant)
    verb, _, which = str(values.get("do", "")).partition(":")
    typed = _with_common_visit({str(k): str(v) for k, v in values.items()})
    rows = study.proposals_of_participant(db, participant.id)
    behind = repository.proposals(db, [s.id for s in rows])
    refused: dict[int, BetaloopError] = {}
    confirmed: list[int] = []
    for session in rows:
        if f"version-{session.id}" not in values or session.id not in behind:
            continue
        mine = which == str(session.id)
        try:
            with db.begin_nested():
                if _decide_one(db, session, behind[session.id], verb, mine, which == "all", typed, caller):
                    confirmed.append(session.id)
        except BetaloopError as error:
            refused[session.id] = error
    if which.isdecimal() and int(which) not in {s.id for s in rows}:
        gone = Invalid(f"Session {which} is no proposal any more: somebody confirmed, cut or dropped it.", "Nothing was changed.")
        return _page(request, db, participant, caller, error=gone)
    if refused:
        return _page(request, db, participant, caller, refused=refused, sent=typed, confirmed=confirmed)
    done = DONE.get(verb, "saved")
    listed = f"&confirmed={','.join(map(str, confirmed))}" if confirmed else ""
    return RedirectResponse(f"/participants/{participant.code}/proposals?done={done}{listed}", 303)


def _with_common_visit(values: Mapping[str, str]) -> dict[str, str]:
    """Fill the visit that the form states for every row without one into those rows."""
    common = values.get("visit-all", "").strip()
    return {k: common if re.fullmatch(r"visit-\d+", k) and not v.strip() else v for k, v in values.items()}


@router.post("/uploaded-files/{file_id}/session")
def attach(request: Request, file_id: RowId, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Attach a grasp file to its session."""
    file, participant = repository.upload_file(db, file_id, caller, lock=True)
    access.require(caller, can.WRITE_STUDY, participant)
    chosen = str(values.get("session_id", ""))
    try:
        with about("session_id"):
            if not chosen.isdecimal() or len(chosen) > 9:
                raise Invalid("No session was chosen.", "Choose the session that the test belongs to.")
            service.attach_grasps(db, file, study.session(db, int(chosen), caller))
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, participant, caller, error=error, attached=(file_id, chosen))
    return RedirectResponse(f"/participants/{participant.code}/proposals?done=attached", 303)


@router.post("/sessions/{session_id}/clock")
def correct_clock(request: Request, session_id: RowId, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """State how far the clock of a session's recording was ahead of UTC; its recordings move, and their sessions with them."""
    session = study.session(db, session_id, caller)
    typed = {name: str(values.get(name, "")).strip() for name in ("ahead_s", "uncertainty_s", "clock_reason")}
    try:
        fields = {"ahead_s": typed["ahead_s"], "uncertainty_s": typed["uncertainty_s"], "reason": typed["clock_reason"]}
        clocks.correct(db, session, parse(ClockIn, fields, OWN, {"reason": "clock_reason"}), caller)
    except BetaloopError as error:
        db.rollback()
        return session_pages.shown_again(request, db, study.session(db, session_id, caller), caller, error, typed)
    return RedirectResponse(f"/sessions/{session_id}?done=clock", 303)


def _decide_one(
    db: Session,
    session: StudySession,
    proposal: SessionProposal,
    verb: str,
    mine: bool,
    everyone: bool,
    values: Mapping[str, str],
    caller: Caller,
) -> bool:
    """Decide on one proposal of the posted form; returns whether it was confirmed."""
    stored = texts(db, session, proposal, caller)
    own = own_texts(values, session.id, stored)
    typed = {**stored, **own}
    version = values[f"version-{session.id}"]
    mine_typed = typed_own(values, session.id)
    if mine and verb == "discard":
        why = values.get(f"reason-{session.id}", "").strip()
        if not why:
            raise Invalid("A proposal is dropped with a reason.", "Say why this is no session.", field="reason")
        proposals.discard(db, session, _version(version), why[:1000], caller)
    elif mine and verb == "split":
        _cut(db, session, _version(version), typed_parts(values, session.id), caller)
    elif mine and verb == "amplitude":
        with about("source"):
            chosen = {"source": mine_typed["source"], "reason": mine_typed["source_reason"]}
            choice = parse(AmplitudeChoice, chosen, OWN, {"reason": "source_reason"})
            proposals.choose_amplitude(db, session, _version(version), choice, caller)
    elif mine and verb == "clock":
        offset = {"ahead_s": mine_typed["ahead_s"], "uncertainty_s": mine_typed["uncertainty_s"], "reason": mine_typed["clock_reason"]}
        with about("ahead_s"):
            proposals.locked(db, session, _version(version), caller)
            clocks.correct(db, session, parse(ClockIn, offset, OWN, {"reason": "clock_reason"}), caller)
    elif mine and verb == "visit":
        if own:
            version = str(proposals.change(db, session, as_change(session, version, stored, typed), caller).version)
        add_visit_of_recording(db, session, _version(version), caller)
    elif verb == "confirm" and (mine or (everyone and typed["visit"] and typed["controller"])):
        proposals.confirm(db, session, as_change(session, version, stored, typed), caller)
        return True
    elif own:
        # what another tab changed in between stays; an own correction of it is refused by its version, not lost
        proposals.change(db, session, as_change(session, version, stored, typed), caller)
    return False


def _cut(db: Session, session: StudySession, version: int, rows: list[dict[str, str]], caller: Caller) -> None:
    """Cut a recording. An error in a part is reported at the parts, since a correction has other fields."""
    try:
        proposals.split(db, session, version, as_parts(session, rows), caller)
    except Invalid as error:
        if "errors" not in error.extra:
            error.extra["field"] = "parts"
        raise


def _version(text: str) -> int:
    if not text.isdecimal() or len(text) > 9:
        raise Invalid("The form names no version of the proposal.", "Load the page again.")
    return int(text)


def _page(
    request: Request,
    db: Session,
    participant: Participant,
    caller: Caller,
    only: StudySession | None = None,
    error: BetaloopError | None = None,
    refused: Mapping[int, BetaloopError] | None = None,
    sent: Mapping[str, str] | None = None,
    confirmed: list[int] | None = None,
    attached: tuple[int, str] | None = None,
) -> HTMLResponse:
    refused, sent = refused or {}, sent or {}
    waiting = [only] if only else list(study.proposals_of_participant(db, participant.id))
    behind = repository.proposals(db, [s.id for s in waiting])
    visits = study.visits(db, participant.id, 1000, 0)[0]
    forms = [
        _form(request, db, s, behind[s.id], caller, refused.get(s.id), sent, visits) for s in waiting[:SHOWN] if s.id in behind
    ]  # fmt: skip
    everyone = study.sessions_of_participant(db, participant.id, with_proposals=True)
    fresh = [(s, sentences(contradictions(db, s))) for s in everyone if s.id in (confirmed or []) and s.status == "confirmed"]
    page = render(
        request,
        "ingest/proposals.html",
        participant=participant,
        only=only,
        forms=forms,
        beyond=max(len(waiting) - SHOWN, 0),
        chart=_chart(db, only) if only and may_know(only.visit, caller) else None,
        confirmed=fresh,
        attached=attached,
        remarks=field_notes(error, {"session_id": ""}) if attached else {},
        grasp_files=[] if only else repository.waiting_grasp_files(db, participant.id),
        sessions=everyone,
        visits=visits,
        hidden=(HIDDEN, "hidden: kept as it is"),
        controllers=[("", "open: choose …"), *((c.value, name) for c, name in CONTROLLER_NAMES.items())],
        policies=study.policy_names(db, participant.id),
        may_write=caller.may(can.WRITE_STUDY, participant.site.study_id, participant.site_id),
        problem=error.problem(request.url.path) if error else None,
    )
    worst = error or next(iter(refused.values()), None)
    return HTMLResponse(page, worst.status if worst else 200)


def _form(
    request: Request,
    db: Session,
    session: StudySession,
    proposal: SessionProposal,
    caller: Caller,
    error: BetaloopError | None,
    sent: Mapping[str, str],
    visits: Sequence[Visit],
) -> ProposalForm:
    stored = texts(db, session, proposal, caller)
    data = _steps(db, session)
    control = control_recording(session)
    told = may_know(session.visit, caller)
    found = designs.of_session(db, session, data.table, caller) if data and told else None
    remarks = field_notes(renamed(error, FIELDS) if error else None, stored)
    return ProposalForm(
        session,
        proposal,
        stored,
        {**stored, **own_texts(sent, session.id, stored)} if error else stored,
        typed_parts(sent if error else {}, session.id),
        is_clocked(session),
        wording.reasons(proposal.evidence, session.visit.sealed),
        sentences(contradictions(db, session, proposal.visit_open)),
        drawn_words(found) if found else "",
        usable_steps(db, session),
        control_programs(db, session),
        thumbnail(data) if data and told else None,
        sent.get(f"reason-{session.id}", "") if error else "",
        error.problem(request.url.path) if error else None,
        remarks,
        visit_to_add(session, proposal, visits),
        told and has_markers(session),
        open_questions(session) if told else 0,
        [c.as_api(told) for c in amplitude_sources.of_session(session)],
        clock_words(control) if control.started_at is not None else "",
        unknown_clock(control),
        typed_own(sent if error else {}, session.id),
    )


def _steps(db: Session, session: StudySession) -> SessionData | None:
    try:
        return session_data(db, session)
    except Invalid:
        return None  # the proposal's notes say why its steps cannot be read


def _chart(db: Session, session: StudySession) -> Any:
    data = _steps(db, session)
    return control_chart(data) if data and (data.table.beta_trace or data.table.amplitude_trace) else None
