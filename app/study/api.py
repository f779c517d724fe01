"""REST routes of the study: HTTP in and out, nothing else."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Path
from numpy.typing import NDArray

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.web.schemas import Page, PagingQuery, RowId, problems
from app.study import blinding, repository, service
from app.study.models import Participant, StudySession, Visit
from app.study.outcomes import service as outcomes
from app.study.outcomes import values as outcome_values
from app.study.schemas import (
    DerivedChoice,
    OutcomeOut,
    ParticipantIn,
    ParticipantOut,
    QocIn,
    QocOut,
    SessionChange,
    SessionOut,
    SettingsChange,
    SettingsOut,
    TraceOut,
    VisitChange,
    VisitIn,
    VisitOut,
)
from app.study.service import SessionData

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


def current_participant(code: Annotated[str, Path(max_length=40, pattern=r"^[^\x00]*$")], db: Db, caller: CurrentCaller) -> Participant:
    """The participant that the path names."""
    return repository.participant_by_code(db, code, caller)


def current_visit(visit_id: RowId, db: Db, caller: CurrentCaller) -> Visit:
    """The visit that the path names."""
    return repository.visit(db, visit_id, caller)


def current_session(session_id: RowId, db: Db, caller: CurrentCaller) -> StudySession:
    """The session that the path names."""
    return repository.session(db, session_id, caller)


CurrentParticipant = Annotated[Participant, Depends(current_participant)]
CurrentVisit = Annotated[Visit, Depends(current_visit)]
CurrentSession = Annotated[StudySession, Depends(current_session)]


@router.get("/participants")
def list_participants(db: Db, caller: CurrentCaller, paging: PagingQuery) -> Page[ParticipantOut]:
    """Participants the caller may see, by code."""
    rows, total = repository.participants(db, caller, paging.limit, paging.offset)
    return Page(items=[participant_out(p) for p in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.post("/participants", status_code=201, responses=problems(409))
def enrol(draft: ParticipantIn, db: Db, caller: CurrentCaller) -> ParticipantOut:
    """Enrol a participant."""
    participant = service.enrol(db, draft, caller)
    db.commit()
    return participant_out(participant)


@router.get("/participants/{code}")
def read_participant(participant: CurrentParticipant) -> ParticipantOut:
    """One participant with its present settings."""
    return participant_out(participant)


@router.get("/participants/{code}/settings")
def list_settings(participant: CurrentParticipant) -> list[SettingsOut]:
    """All settings versions, oldest first."""
    return [SettingsOut.model_validate(s) for s in participant.settings]


@router.put("/participants/{code}/settings", responses=problems(409))
def change_settings(participant: CurrentParticipant, change: SettingsChange, db: Db, caller: CurrentCaller) -> SettingsOut:
    """Change settings: a new version; members left out keep their value."""
    row = service.change_settings(db, participant, change.settings, change.reason, caller)
    db.commit()
    return SettingsOut.model_validate(row)


@router.get("/participants/{code}/visits")
def list_visits(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[VisitOut]:
    """Visits of a participant, by number."""
    rows, total = repository.visits(db, participant.id, paging.limit, paging.offset)
    return Page(items=[visit_out(v, participant.code) for v in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.post("/participants/{code}/visits", status_code=201, responses=problems(409))
def add_visit(participant: CurrentParticipant, draft: VisitIn, db: Db, caller: CurrentCaller) -> VisitOut:
    """Add a visit."""
    visit = service.add_visit(db, participant, draft, caller)
    db.commit()
    return visit_out(visit, participant.code)


@router.get("/visits/{visit_id}")
def read_visit(visit: CurrentVisit) -> VisitOut:
    """One visit."""
    return visit_out(visit, visit.participant.code)


@router.patch("/visits/{visit_id}")
def change_visit(visit: CurrentVisit, change: VisitChange, db: Db, caller: CurrentCaller) -> VisitOut:
    """Correct a visit: its date, its note, its cDBS amplitudes; amplitude fractions of its sessions follow."""
    service.change_visit(db, visit, change, caller)
    db.commit()
    return visit_out(visit, visit.participant.code)


@router.get("/visits/{visit_id}/sessions")
def list_sessions(visit: CurrentVisit, db: Db, caller: CurrentCaller, paging: PagingQuery) -> Page[SessionOut]:
    """Confirmed sessions of a visit, in order; proposals stand under the participant's."""
    rows, total = repository.sessions_of_visit(db, visit.id, paging.limit, paging.offset)
    return Page(items=[session_out(s, caller) for s in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.get("/sessions/{session_id}")
def read_session(session: CurrentSession, caller: CurrentCaller) -> SessionOut:
    """One session."""
    return session_out(session, caller)


@router.patch("/sessions/{session_id}")
def change_session(session: CurrentSession, change: SessionChange, db: Db, caller: CurrentCaller) -> SessionOut:
    """Correct a session: its controller, channel, hemisphere, or whether it counts."""
    service.change_session(db, session, change, caller)
    db.commit()
    return session_out(session, caller)


@router.get("/sessions/{session_id}/trace")
def read_trace(session: CurrentSession, db: Db) -> TraceOut:
    """Beta and amplitude on the 2 s grid; rows with t_s <= 0 are the window before the session."""
    return trace_out(service.session_data(db, session))


@router.get("/sessions/{session_id}/qoc")
def read_qoc(session: CurrentSession) -> QocOut | None:
    """Newest revision of the QoCs, null when none was entered."""
    return QocOut.model_validate(session.qoc) if session.qoc else None


@router.put("/sessions/{session_id}/qoc")
def record_qoc(session: CurrentSession, values: QocIn, db: Db, caller: CurrentCaller) -> QocOut:
    """Enter or correct the QoCs of a session."""
    row = service.record_qoc(db, session, values, caller)
    db.commit()
    return QocOut.model_validate(row)


@router.get("/sessions/{session_id}/outcomes")
def read_outcomes(session: CurrentSession, db: Db) -> list[OutcomeOut]:
    """QoCs as the uploaded files give them, with what they rest on; `conflicts` where a person's value stands against them."""
    return [outcome_out(session, d) for d in outcome_values.derive(db, session)]


@router.post("/sessions/{session_id}/outcomes")
def take_outcome(session: CurrentSession, choice: DerivedChoice, db: Db, caller: CurrentCaller) -> QocOut:
    """Put the value that the files give in the place of a typed one; `value` is the one that was read before."""
    row = service.take_derived(db, session, choice, caller)
    db.commit()
    return QocOut.model_validate(row)


def outcome_out(session: StudySession, derived: outcome_values.Derived) -> OutcomeOut:
    """A derived QoC for the API."""
    conflicts = bool(outcomes.disagreements(session, [derived]))
    return OutcomeOut.model_validate(
        {"name": derived.name, "value": derived.value, "unit": derived.unit, "basis": derived.basis, "conflicts": conflicts}
    )


def participant_out(p: Participant) -> ParticipantOut:
    """A participant for the API."""
    return ParticipantOut(
        code=p.code, status=p.status, site=p.site.code, created_at=p.created_at, settings=SettingsOut.model_validate(p.current_settings)
    )


def visit_out(v: Visit, code: str) -> VisitOut:
    """A visit for the API."""
    amplitudes = [{"hemisphere": a.hemisphere, "program": a.program, "amplitude_ma": a.amplitude_ma} for a in v.cdbs_amplitudes]
    return VisitOut.model_validate(
        {"id": v.id, "participant": code, "number": v.number, "date": v.date, "note": v.note or "", "cdbs_amplitudes": amplitudes}
    )


def session_out(s: StudySession, caller: Caller) -> SessionOut:
    """A session for the API; the controller comes through the blinding gate."""
    arm = blinding.stated_arm(s, caller)
    return SessionOut(
        id=s.id,
        visit_id=s.visit_id,
        visit=s.visit.number,
        participant=s.visit.participant.code,
        ordinal=s.ordinal,
        controller=arm.controller if arm else None,
        policy_id=arm.policy_id if arm else None,
        hemisphere=s.hemisphere,
        status=s.status,
        started_at=s.started_at,
        duration_s=s.duration_s,
        control_channel=s.control_channel,
        excluded_reason=s.excluded_reason,
        recordings=sorted({g.recording_id for g in s.segments}),
        qoc=QocOut.model_validate(s.qoc) if s.qoc else None,
    )


def trace_out(data: SessionData) -> TraceOut:
    """A step table for the API."""
    table, beta = data.table, data.table.beta_trace
    return TraceOut(
        session_id=data.session.id,
        period_s=data.settings.period_s,
        beta_unit=beta.unit if beta else None,
        beta_source=beta.source if beta else None,
        beta_channel=beta.channel if beta else None,
        decode_version=beta.decode_version if beta else None,
        cdbs_amplitude_ma=table.cdbs_ma,
        xi_beta=data.threshold,
        steps_above_cdbs=table.above_one,
        t_s=table.t_s.tolist(),
        beta=_nullable(table.beta),
        amplitude_ma=_nullable(table.amplitude_ma),
        amplitude_fraction=_nullable(table.fraction),
    )


def _nullable(values: NDArray[np.float64]) -> list[float | None]:
    return [None if np.isnan(v) else float(v) for v in values]
