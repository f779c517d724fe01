"""HTML page of a session: its traces, stimulation, data quality, QoCs and corrections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.numbers import typed
from app.platform.web.forms import FormValues, confirmed, field_notes, parse
from app.platform.web.templates import render
from app.study import access, repository
from app.study.adverse_event_types import CHOICES, EVENT_KINDS, EVENT_SEVERITIES
from app.study.adverse_events import events_of_session
from app.study.blinding import CONTROLLER_NAMES, arm, may_know, require_known
from app.study.data_queries import not_closed_of_session
from app.study.deps import CurrentSession, SessionViewed
from app.study.doses import since_last_dose
from app.study.recordings import history
from app.study.recordings.controller_log import LEAST_SHARE
from app.study.recordings.facts import clock_words, unknown_clock
from app.study.schemas import ConditionsChange, DerivedChoice, QocIn, SessionChange
from app.study.sessions import changes as study_changes
from app.study.sessions import conditions, designs
from app.study.sessions import view as session_view
from app.study.sessions.charts import beta_by_amplitude, in_chart_table, notes, operator_conflicts, stimulation_steps
from app.study.sessions.contradictions import contradictions, control_recording
from app.study.sessions.stimulation import beside, delivered, has_markers, open_questions
from app.study.sessions.usable_steps import SessionData, late_s, late_words, session_data
from app.study.sessions.wording import ACTIVITIES, drawn_words, sentences
from app.study.settings_form import Shown, own_changes
from app.study.traces import NO_CONTROL, control_programs, session_offset_s
from app.study.visits import blinded_page
from app.tables.outcomes import QocRevision
from app.tables.recordings import Recording
from app.tables.sessions import StudySession
from ml.energy import relative_energy
from ml.formats import DEVICE_NAMES
from ml.outcomes import FIELDS, OUTCOMES

router = APIRouter()

_QOC_LABELS = {o.field: o.label for o in OUTCOMES} | {"reason": "Reason"}
_CORRECTION_LABELS = {
    "controller": "Controller", "policy": "Policy", "hemisphere": "Hemisphere", "control": "Control trace", "correction_reason": "Reason",
    "control_program": "Program",
    "stopped_reason": "Stopped for the patient's sake", "medication_h": "Time since the last dose", "activity": "Before the session",
}  # fmt: skip
_CONDITIONS_LABELS = {
    "lower_bound": "Lower bound B", "xi_beta": "Beta threshold", "min_ma": "Lowest amplitude", "max_ma": "Highest amplitude",
    "lead_amplitude_ma": "Amplitude before", "conditions_reason": "Reason",
}  # fmt: skip


_STATED = ("controller", "hemisphere", "stopped_reason", "medication_h", "activity", "control_program")


@dataclass(frozen=True)
class Summary:
    """A session in a few numbers.

    Attributes:
        steps, beta_steps, amplitude_steps: of the session, and those with a valid beta and a known amplitude.
        gaps, longest_gap_s: stretches without beta within the session.
        median_beta: in `unit`; None without beta.
        below_threshold: share of valid steps with beta below xi_beta; None without a threshold or beta.
        mean_fraction, energy: of the steps with a known fraction; energy relative to cDBS; None without any.
        above_cdbs: steps above 100 % of the cDBS amplitude.
    """

    steps: int
    beta_steps: int
    amplitude_steps: int
    gaps: int
    longest_gap_s: float
    unit: str
    median_beta: float | None
    below_threshold: float | None
    mean_fraction: float | None
    energy: float | None
    above_cdbs: int


def summarise(data: SessionData) -> Summary:
    """Summarise a session's step table in numbers."""
    table, settings = data.table, data.settings
    inside = table.t_s > 0
    beta, fraction = table.beta[inside], table.fraction[inside]
    missing = np.isnan(beta)
    edges = np.flatnonzero(np.diff(np.r_[False, missing, False].astype(int)))
    lengths = edges[1::2] - edges[::2]
    valid, known = beta[~missing], fraction[~np.isnan(fraction)]
    return Summary(
        steps=int(inside.sum()),
        beta_steps=int(valid.size),
        amplitude_steps=int(np.sum(~np.isnan(fraction) | ~np.isnan(table.amplitude_ma[inside]))),
        gaps=int(lengths.size),
        longest_gap_s=float(lengths.max(initial=0) * settings.period_s),
        unit=table.beta_trace.unit if table.beta_trace else "",
        median_beta=float(np.median(valid)) if valid.size else None,
        below_threshold=float(np.mean(valid < data.threshold)) if valid.size and data.threshold is not None else None,
        mean_fraction=float(known.mean()) if known.size else None,
        energy=relative_energy(fraction) if known.size else None,
        above_cdbs=table.above_one,
    )


@router.get("/sessions/{session_id}", dependencies=[SessionViewed])
def session_page(request: Request, session: CurrentSession, db: Db, caller: CurrentCaller) -> Response:
    """Show one session; redirect a proposal to the page where it is confirmed."""
    if session.status == "proposed":
        return RedirectResponse(f"/proposals/{session.id}", 303)
    return _page(request, db, session, caller)


@router.post("/sessions/{session_id}/qoc")
def record_qoc(request: Request, session: CurrentSession, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Enter or correct QoCs."""
    # what was left as shown keeps its digits, which the form does not show, and what others entered meanwhile
    seen = str(values["revision"]) if "revision" in values else None
    changes = own_changes(values, seen, _qoc_revisions(session), _QOC_LABELS)
    reason = {"reason": str(values["reason"])} if "reason" in values else {}
    try:
        access.require(caller, can.WRITE_QOC, session.visit.participant)
        changes.refuse_conflicts()
        answers = {"sure": confirmed(values, changes.fields)}
        study_changes.record_qoc(db, session, parse(QocIn, changes.fields | reason | answers, _QOC_LABELS), caller)
    except BetaloopError as error:
        db.rollback()
        if _on_blinded_page(session, caller):
            return blinded_page(request, db, session.visit, caller, error, session, changes.fields | reason)
        return _page(request, db, session, caller, error, typed=changes.fields | reason)
    if _on_blinded_page(session, caller):
        return RedirectResponse(f"/visits/{session.visit_id}?done=qoc", 303)
    return RedirectResponse(f"/sessions/{session.id}?done=qoc", 303)


@router.post("/sessions/{session_id}/exclusion")
def exclude(request: Request, session: CurrentSession, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Keep a session out of buffers and analyses, or take it in again."""
    include = values.get("include") == "yes"
    why = str(values.get("excluded_reason", "")).strip()
    try:
        if not include and not why:
            raise Invalid("An exclusion needs a reason.", "Say why the session shall not count.", field="excluded_reason")
        change = SessionChange(excluded_reason=None if include else why[:1000], reason="included again" if include else why[:1000])
        study_changes.change_session(db, session, change, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, session, caller, error)
    return RedirectResponse(f"/sessions/{session.id}?done={'included' if include else 'excluded'}", 303)


@router.post("/sessions/{session_id}/correction")
def correct(request: Request, session: CurrentSession, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Correct what a session was: controller, policy, hemisphere, the trace that drove the controller."""
    # only what the form changed of what it showed, so that an old form takes back nothing that another person corrected meanwhile
    present = Shown(1, _correction(session, caller), repository.last_editor(db, "session", session.id))
    shown = Shown(0, {n: str(values.get(f"seen_{n}", text)) for n, text in present.fields.items()}, "")
    changes = own_changes(values, "0", [shown, present], _CORRECTION_LABELS)
    reason = str(values.get("reason", "")).strip()[:1000]
    try:
        access.require(caller, can.WRITE_STUDY, session.visit.participant)
        changes.refuse_conflicts()
        fields: dict[str, Any] = {n: changes.fields[n] for n in _STATED if n in changes.fields} | {"reason": reason}
        if "policy" in changes.fields:
            policy = changes.fields["policy"]
            fields["policy_id"] = _policy_id(db, session, policy) if policy else ""
        stream, _, channel = changes.fields.get("control", "").partition("\t")
        if stream:
            fields |= {"control_stream": stream, "control_channel": channel}
        study_changes.change_session(db, session, parse(SessionChange, fields, _CORRECTION_LABELS), caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, session, caller, error, typed=changes.fields | {"correction_reason": reason})
    return RedirectResponse(f"/sessions/{session.id}?done=corrected", 303)


@router.post("/sessions/{session_id}/conditions")
def correct_conditions(request: Request, session: CurrentSession, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Correct what a session ran under."""
    seen = str(values["revision"]) if "revision" in values else None
    changes = own_changes(values, seen, _conditions_revisions(session), _CONDITIONS_LABELS)
    reason = str(values.get("conditions_reason", "")).strip()[:1000]
    try:
        access.require(caller, can.WRITE_STUDY, session.visit.participant)
        require_known(session.visit, caller)  # before a refusal could reveal anything
        changes.refuse_conflicts()
        labels = _CONDITIONS_LABELS | {"reason": "Reason"}
        conditions.change(db, session, parse(ConditionsChange, changes.fields | {"reason": reason}, labels), caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, session, caller, error, typed=changes.fields | {"conditions_reason": reason})
    return RedirectResponse(f"/sessions/{session.id}?done=conditions", 303)


@router.post("/sessions/{session_id}/derived")
def take_derived(request: Request, session: CurrentSession, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Put the value that the uploaded files give in the place of a typed one."""
    try:
        shown = parse(DerivedChoice, {"name": values.get("name", ""), "value": values.get("value", "")}, {"value": "Derived value"})
        study_changes.take_derived(db, session, shown, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, session, caller, error)
    return RedirectResponse(f"/sessions/{session.id}?done=derived", 303)


def _correction(session: StudySession, caller: Caller) -> dict[str, str]:
    """Return what the form of corrections shows of a session."""
    known = arm(session, caller)
    return {
        "controller": known.controller.value,
        "policy": "" if known.policy_id is None else str(known.policy_id),
        "hemisphere": session.hemisphere or "",
        "control": f"{session.control_stream}\t{session.control_channel or ''}",
        "control_program": "" if session.control_program is None else str(session.control_program),
        "stopped_reason": session.stopped_reason or "",
        "medication_h": "" if session.medication_h is None else f"{session.medication_h:g}",
        "activity": session.activity or "",
    }


def _on_blinded_page(session: StudySession, caller: Caller) -> bool:
    """Check whether the caller enters QoCs on the blinded page of the visit."""
    return not may_know(session.visit, caller) and not access.may(caller, can.READ_ARMS, session.visit.participant)


def _qoc_revisions(session: StudySession) -> list[Shown]:
    """List every revision as the form showed it; before the first one, it was empty."""
    return [Shown(0, _shown_qoc(None), ""), *(Shown(q.revision, _shown_qoc(q), q.entered_by) for q in session.qocs)]


def _shown_qoc(revision: QocRevision | None) -> dict[str, str]:
    """Write QoCs as the form shows them."""
    values = {n: getattr(revision, n, None) for n in FIELDS}
    return {name: typed(value) for name, value in values.items()}


def _conditions_revisions(session: StudySession) -> list[Shown]:
    """List every revision of a session's conditions as the form showed it; before the first one, it was empty."""
    names = [n for n in _CONDITIONS_LABELS if n != "conditions_reason"]
    found = [Shown(0, dict.fromkeys(names, ""), "")]
    for row in session.conditions_revisions:
        values = {n: getattr(row, n) for n in names}
        found.append(Shown(row.revision, {n: typed(v, 6) for n, v in values.items()}, row.entered_by))
    return found


def _policy_id(db: Session, session: StudySession, name: str) -> int:
    found = repository.policy_id(db, session.visit.participant_id, name)
    if found is None:
        raise Invalid(f"Participant {session.visit.participant.code} has no policy '{name}'.", "Give the name or number of one.")
    return found


def _page(
    request: Request,
    db: Session,
    session: StudySession,
    caller: Caller,
    error: BetaloopError | None = None,
    typed: dict[str, str] | None = None,
) -> HTMLResponse:
    participant = session.visit.participant
    if session.visit.sealed and not may_know(session.visit, caller):
        return _sealed_page(request, db, session, caller, error, typed)
    recordings = list(dict.fromkeys(s.recording for s in session.segments))
    traces = {r.id: repository.traces_of_recording(db, r.id) for r in recordings}
    data, trouble = None, None
    try:
        data = session_data(db, session)
    except BetaloopError as unreadable:
        trouble = unreadable.problem(request.url.path)
    view = session_view.shown_trace(session, data, traces, request.query_params.get("trace", ""))
    known, seen = _shown_qoc(session.qoc), _correction(session, caller)
    events, origin = _control_events(session, recordings)
    steps = stimulation_steps(data, events, origin) if data else []
    page = render(
        request,
        "study/sessions/session.html",
        session=session,
        visit=session.visit,
        participant=participant,
        arm=arm(session, caller),
        policy_name=repository.policy_name(db, arm(session, caller).policy_id),
        controllers=[(c.value, name) for c, name in CONTROLLER_NAMES.items()],
        data=data,
        trouble=trouble,
        summary=summarise(data) if data else None,
        contradictions=sentences(contradictions(db, session, steps_shown=True)),
        late=late_words(late_s(data)) if data else "",
        control=control_recording(session),
        view=view,
        steps=steps,
        steps_in_chart=data is not None and view.is_control and view.chart is not None and in_chart_table(data, steps),
        conflicts=operator_conflicts(events, origin),
        notes=notes(events, origin, session.duration_s),
        by_amplitude=beta_by_amplitude(data) if data else None,
        blocks=session_view.recording_blocks(session, recordings, traces, view.used),
        outcomes=session_view.outcomes_view(db, session),
        programs=control_programs(db, session),
        streams=[t for r in recordings for t in traces[r.id] if t.stream not in NO_CONTROL],
        recordings=recordings,
        markers=has_markers(session),
        questions=open_questions(session),
        samples=any(recording.details.get("spectra") for recording in recordings),
        qoc=known | {"reason": ""} | {k: v for k, v in (typed or {}).items() if k in (*known, "reason")},
        correction=seen | {"correction_reason": ""} | {k: v for k, v in (typed or {}).items() if k in _CORRECTION_LABELS},
        seen=seen,
        clock=clock_words(control_recording(session)) if control_recording(session).started_at is not None else "",
        clock_unknown=unknown_clock(control_recording(session)),
        clock_typed={n: (typed or {}).get(n, "") for n in ("ahead_s", "uncertainty_s", "clock_reason")},
        open_queries=not_closed_of_session(db, session.id),
        since=since_last_dose(session),
        activities=ACTIVITIES,
        device_names=DEVICE_NAMES,
        events=events_of_session(db, session.id),
        event_kinds=EVENT_KINDS,
        event_severities=EVENT_SEVERITIES,
        event_choices=CHOICES,
        drawn=_drawn(db, session, data, caller),
        ran_on=history.of_recording(control_recording(session)),
        least_share=LEAST_SHARE,
        beside=_beside(db, session, data),
        ran_under=dict(_conditions_revisions(session)[-1].fields)
        | {"conditions_reason": ""}
        | {k: v for k, v in (typed or {}).items() if k in _CONDITIONS_LABELS},
        may_write=caller.may(can.WRITE_STUDY, participant.site.study_id, participant.site_id),
        problem=error.problem(request.url.path) if error else None,
        remarks=field_notes(error, typed or {}),
    )
    return HTMLResponse(page, error.status if error else 200)


shown_again = _page
"""Page of a session with what was wrong in a form of another phase, and what was typed there."""


def _sealed_page(
    request: Request, db: Session, session: StudySession, caller: Caller, error: BetaloopError | None, typed: dict[str, str] | None
) -> HTMLResponse:
    """Render a session of a blinded plan whose key is sealed: its letter and outcomes, and nothing that reveals what ran."""
    participant = session.visit.participant
    known = _shown_qoc(session.qoc)
    page = render(
        request,
        "study/sessions/session_sealed.html",
        session=session,
        visit=session.visit,
        participant=participant,
        contradictions=sentences(contradictions(db, session)),
        outcomes=session_view.outcomes_view(db, session),
        qoc=known | {"reason": ""} | {k: v for k, v in (typed or {}).items() if k in (*known, "reason")},
        events=events_of_session(db, session.id),
        event_kinds=EVENT_KINDS,
        event_severities=EVENT_SEVERITIES,
        event_choices=CHOICES,
        may_write=caller.may(can.WRITE_STUDY, participant.site.study_id, participant.site_id),
        problem=error.problem(request.url.path) if error else None,
        remarks=field_notes(error, typed or {}),
    )
    return HTMLResponse(page, error.status if error else 200)


def _drawn(db: Session, session: StudySession, data: SessionData | None, caller: Caller) -> str:
    """Describe how a random session's amplitudes were drawn; empty for other sessions and where its steps cannot be read."""
    found = designs.of_session(db, session, data.table, caller) if data else None
    return drawn_words(found) if found else ""


def _beside(db: Session, session: StudySession, data: SessionData | None) -> list[str]:
    """List sides and programs that stimulated too, of which mean amplitude and energy hold nothing."""
    if data is None:
        return []
    try:
        return beside(delivered(db, session), data.table.amplitude_trace)
    except Invalid:
        return []  # the contradictions of the session say what cannot be read


def _control_events(session: StudySession, recordings: list[Recording]) -> tuple[list[dict[str, Any]], float]:
    """Return events of the recording that the controller saw, as stored, and where the session starts in its clock, seconds."""
    control = {s.recording_id for s in session.segments if s.is_control}
    for recording in recordings:
        if recording.id in control:
            return list(recording.details.get("events", [])), session_offset_s(session, recording.id)
    return [], 0.0
