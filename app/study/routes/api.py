"""REST routes of the study: HTTP in and out, nothing else."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import Page, PagingQuery, problems
from app.study import participation as enrolment
from app.study import repository, settings
from app.study import visits as study_visits
from app.study.blinding import require_known
from app.study.deps import CurrentParticipant, CurrentSession, CurrentVisit, SessionViewed, VisitViewed
from app.study.outcomes import values as outcome_values
from app.study.participation import ParticipantIn
from app.study.routes.serializers import lock_rows, outcome_out, participant_out, recorded_trace_out, session_out, trace_out, visit_out
from app.study.schemas import (
    ConditionsChange,
    ConditionsOut,
    DerivedChoice,
    OutcomeOut,
    ParticipantOut,
    QocIn,
    QocOut,
    RecordedTraceOut,
    SessionChange,
    SessionOut,
    TraceOut,
    VisitChange,
    VisitIn,
    VisitLockIn,
    VisitLockOut,
    VisitOut,
    VisitUnlockIn,
)
from app.study.sessions import changes, conditions
from app.study.sessions.usable_steps import session_data
from app.study.settings_types import SettingsChange, SettingsOut
from app.study.traces import recorded_traces

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@router.get("/participants")
def list_participants(db: Db, caller: CurrentCaller, paging: PagingQuery) -> Page[ParticipantOut]:
    """List participants the caller may see, by code."""
    rows, total = repository.participants(db, caller, paging.limit, paging.offset)
    return Page(items=[participant_out(p) for p in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.post("/participants", status_code=201, responses=problems(409))
def enrol(draft: ParticipantIn, db: Db, caller: CurrentCaller) -> ParticipantOut:
    """Enrol a participant."""
    participant = enrolment.enrol(db, draft, caller)
    return participant_out(participant)


@router.get("/participants/{code}")
def read_participant(participant: CurrentParticipant) -> ParticipantOut:
    """Return one participant with its present settings."""
    return participant_out(participant)


@router.get("/participants/{code}/settings")
def list_settings(participant: CurrentParticipant) -> list[SettingsOut]:
    """List all settings versions, oldest first."""
    return [SettingsOut.model_validate(s) for s in participant.settings]


@router.put("/participants/{code}/settings", responses=problems(409))
def change_settings(participant: CurrentParticipant, change: SettingsChange, db: Db, caller: CurrentCaller) -> SettingsOut:
    """Change settings: a new version; omitted members keep their value."""
    row = settings.change_settings(db, participant, change.settings, change.reason, caller, change.sure)
    return SettingsOut.model_validate(row)


@router.get("/participants/{code}/visits")
def list_visits(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[VisitOut]:
    """List visits of a participant, by number."""
    rows, total = repository.visits(db, participant.id, paging.limit, paging.offset)
    return Page(items=[visit_out(v, participant.code) for v in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.post("/participants/{code}/visits", status_code=201, responses=problems(409))
def add_visit(participant: CurrentParticipant, draft: VisitIn, db: Db, caller: CurrentCaller) -> VisitOut:
    """Add a visit."""
    visit = study_visits.add_visit(db, participant, draft, caller)
    return visit_out(visit, participant.code)


@router.get("/visits/{visit_id}")
def read_visit(visit: CurrentVisit) -> VisitOut:
    """Return one visit."""
    return visit_out(visit, visit.participant.code)


@router.patch("/visits/{visit_id}", responses=problems(409))
def change_visit(visit: CurrentVisit, change: VisitChange, db: Db, caller: CurrentCaller) -> VisitOut:
    """Correct a visit: its date, its note, its cDBS amplitudes; amplitude fractions of its sessions follow."""
    study_visits.change_visit(db, visit, change, caller)
    return visit_out(visit, visit.participant.code)


@router.get("/visits/{visit_id}/locks")
def list_locks(visit: CurrentVisit, db: Db) -> list[VisitLockOut]:
    """List locks and unlocks of a visit, oldest first; the last one applies."""
    return lock_rows(db, visit)


@router.post("/visits/{visit_id}/lock", responses=problems(409, 429))
def lock_visit(visit: CurrentVisit, why: VisitLockIn, db: Db, caller: CurrentCaller) -> VisitLockOut:
    """Close the data of a visit for changes, signed as complete and reviewed; blinded assessors see its controllers from now on.

    The signature covers the visit, its doses, and every session with its controller, QoCs, conditions, exclusion and samples.
    """
    study_visits.lock(db, visit, why.reason, caller, why.password, why.code)
    return lock_rows(db, visit)[-1]


@router.post("/visits/{visit_id}/unlock", responses=problems(409))
def unlock_visit(visit: CurrentVisit, why: VisitUnlockIn, db: Db, caller: CurrentCaller) -> VisitLockOut:
    """Open the data of a visit for corrections."""
    study_visits.unlock(db, visit, why.reason, caller)
    return lock_rows(db, visit)[-1]


@router.get("/visits/{visit_id}/sessions", dependencies=[VisitViewed])
def list_sessions(visit: CurrentVisit, db: Db, caller: CurrentCaller, paging: PagingQuery) -> Page[SessionOut]:
    """List confirmed sessions of a visit, in order; proposals are listed under the participant."""
    rows, total = repository.sessions_of_visit(db, visit.id, paging.limit, paging.offset)
    return Page(items=[session_out(s, caller) for s in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.get("/sessions/{session_id}", dependencies=[SessionViewed])
def read_session(session: CurrentSession, caller: CurrentCaller) -> SessionOut:
    """Return one session."""
    return session_out(session, caller)


@router.patch("/sessions/{session_id}", responses=problems(409))
def change_session(session: CurrentSession, change: SessionChange, db: Db, caller: CurrentCaller) -> SessionOut:
    """Correct a session: its controller, channel, hemisphere, or whether it counts."""
    changes.change_session(db, session, change, caller)
    return session_out(session, caller)


@router.get("/sessions/{session_id}/trace", dependencies=[SessionViewed])
def read_trace(session: CurrentSession, db: Db, caller: CurrentCaller) -> TraceOut:
    """Return beta and amplitude on the 2 s grid; rows with t_s <= 0 are the window before the session."""
    require_known(session.visit, caller)
    return trace_out(session_data(db, session))


@router.get("/sessions/{session_id}/traces", dependencies=[SessionViewed])
def read_traces(session: CurrentSession, db: Db, caller: CurrentCaller) -> list[RecordedTraceOut]:
    """Return every trace of every recording of the session: all channels and powers, the amplitudes of all programs and sides."""
    require_known(session.visit, caller)
    return [recorded_trace_out(t) for t in recorded_traces(db, session, session.visit.participant.current_settings)]


@router.get("/sessions/{session_id}/conditions")
def read_conditions(session: CurrentSession, caller: CurrentCaller) -> ConditionsOut | None:
    """Return the conditions of the session; null of a proposal, whose conditions are recorded when it is confirmed."""
    require_known(session.visit, caller)
    return ConditionsOut.model_validate(session.conditions) if session.conditions else None


@router.put("/sessions/{session_id}/conditions", responses=problems(409))
def change_conditions(session: CurrentSession, change: ConditionsChange, db: Db, caller: CurrentCaller) -> ConditionsOut:
    """Correct what the session ran under; buffers made from now on take it from here, those made before keep theirs."""
    require_known(session.visit, caller)
    row = conditions.change(db, session, change, caller)
    return ConditionsOut.model_validate(row)


@router.get("/sessions/{session_id}/qoc")
def read_qoc(session: CurrentSession) -> QocOut | None:
    """Return the newest revision of the QoCs, null when none was entered."""
    return QocOut.model_validate(session.qoc) if session.qoc else None


@router.put("/sessions/{session_id}/qoc", responses=problems(409))
def record_qoc(session: CurrentSession, values: QocIn, db: Db, caller: CurrentCaller) -> QocOut:
    """Enter or correct the QoCs of a session."""
    row = changes.record_qoc(db, session, values, caller)
    return QocOut.model_validate(row)


@router.get("/sessions/{session_id}/outcomes")
def read_outcomes(session: CurrentSession, db: Db) -> list[OutcomeOut]:
    """Return QoCs as the uploaded files give them, with what they rest on; `conflicts` where a person's value differs."""
    return [outcome_out(session, d) for d in outcome_values.derive(db, session)]


@router.post("/sessions/{session_id}/outcomes", responses=problems(409))
def take_outcome(session: CurrentSession, choice: DerivedChoice, db: Db, caller: CurrentCaller) -> QocOut:
    """Put the value that the files give in the place of a typed one; `value` is the one that was read before."""
    row = changes.take_derived(db, session, choice, caller)
    return QocOut.model_validate(row)
