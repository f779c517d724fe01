"""The control channel of a proposal: why it is the one, another one by a person's word, and recordings that have none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from app.ingest import channels
from app.ingest.evidence import Evidence, Reason, Source
from app.study import repository as study
from app.study.sessions import changes
from app.study.sessions.contradictions import control_recording
from app.study.sessions.usable_steps import usable_steps
from app.tables.sessions import StudySession


def survey(session: StudySession) -> Evidence | None:
    """Report that a recording is a survey of sensing montages, in which no controller was at work; None where it is none."""
    recording = control_recording(session)
    if not channels.is_survey(recording):
        return None
    return Evidence(Source.RECORDING, Reason.SURVEY, {"recording": recording.id, "montages": channels.montages(recording)})


def why(db: Session, session: StudySession) -> Evidence:
    """Explain the choice of the control channel: its lead and usable steps, and those of the other channels."""
    recording = control_recording(session)
    traces = [t for t in study.traces_of_recording(db, recording.id) if t.stream == session.control_stream and any(t.valid_bits)]
    chosen = next((t for t in traces if t.channel == session.control_channel), None)
    facts: dict[str, object] = {"stream": session.control_stream, "channel": session.control_channel or "", "lead": "", "passed": []}
    if chosen is not None:
        usable = {u.channel: u.usable for u in usable_steps(db, session) if u.stream == session.control_stream}
        places = {t.channel: channels.place_of(t, recording) for t in traces}
        facts |= {"lead": places[chosen.channel].lead, "usable": usable.get(chosen.channel)}
        others = {c: p for c, p in places.items() if c != chosen.channel}
        facts["passed"] = [{"channel": c, "why": "shorted" if p.shorted else p.lead, "usable": usable.get(c)} for c, p in others.items()]
    return Evidence(Source.RECORDING, Reason.CHANNEL, facts)


def renewed(db: Session, session: StudySession, evidence: Mapping[str, Any]) -> dict[str, Any]:
    """Update the evidence of a proposal whose part changed: the control channel is chosen again for it, unless a person stated it."""
    if "control" in evidence and Evidence.from_json(evidence["control"]).stated:
        return dict(evidence)
    control = next(s for s in session.segments if s.is_control)
    settings = session.visit.participant.current_settings
    traces = study.traces_of_recording(db, control.recording_id)
    chosen = channels.of_part(traces, control.recording, settings, (control.start_s, control.stop_s), session.hemisphere)
    if chosen is not None:
        session.control_stream, session.control_channel = chosen.stream, chosen.channel
        db.flush()
    return dict(evidence) | {"control": why(db, session).as_json()}


def choose_program(db: Session, session: StudySession) -> Evidence | None:
    """Take the program that the controller is likely to have set; why, None where the control recording has one program at most."""
    control = next(s for s in session.segments if s.is_control)
    traces = study.traces_of_recording(db, control.recording_id)
    found = channels.programs_of_part(traces, control.start_s, control.stop_s)
    if len(found) < 2:
        session.control_program = None
        return None
    session.control_program = found[0].number
    known = [{"number": p.number, "how": p.how, "low": p.low, "high": p.high} for p in found if p.how is not channels.How.UNKNOWN]
    unknown = [{"number": p.number, "how": p.how} for p in found if p.how is channels.How.UNKNOWN]
    return Evidence(Source.RECORDING, Reason.PROGRAM, {"program": found[0].number, "programs": [*known, *unknown]})


def renewed_program(db: Session, session: StudySession, evidence: Mapping[str, Any]) -> dict[str, Any]:
    """Update the evidence of a proposal after its part or side changed: the program is chosen again, unless a person stated it."""
    if "program" in evidence and Evidence.from_json(evidence["program"]).stated:
        return dict(evidence)
    why = choose_program(db, session)
    return {name: e for name, e in evidence.items() if name != "program"} | ({"program": why.as_json()} if why else {})


def choose(db: Session, session: StudySession, given: dict[str, object]) -> None:
    """Choose the stated channel, which a control recording of the session must have."""
    changes.check_control(db, session, given)
    session.control_stream = str(given.get("control_stream") or session.control_stream)
    if given.get("control_program") is not None:
        session.control_program = int(str(given["control_program"]))
    if "control_channel" in given:
        session.control_channel = None if given["control_channel"] is None else str(given["control_channel"])
