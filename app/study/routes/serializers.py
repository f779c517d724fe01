"""Rows of the study as API types."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.platform.audit.signatures import SignatureOut
from app.study import blinding
from app.study.doses import hours_since_dose
from app.study.outcomes import service as outcomes
from app.study.outcomes import values as outcome_values
from app.study.schemas import OutcomeOut, ParticipantOut, QocOut, RecordedTraceOut, SessionOut, TraceOut, VisitLockOut, VisitOut
from app.study.sessions.usable_steps import SessionData
from app.study.settings_types import SettingsOut
from app.study.traces import RecordedTrace
from app.study.visits import signatures_of_locks
from app.tables.participants import Participant
from app.tables.sessions import StudySession
from app.tables.visits import Visit


def outcome_out(session: StudySession, derived: outcome_values.Derived) -> OutcomeOut:
    """Convert a derived QoC for the API."""
    conflicts = bool(outcomes.disagreements(session, [derived]))
    return OutcomeOut.model_validate(
        {"name": derived.name, "value": derived.value, "unit": derived.unit, "basis": derived.basis, "conflicts": conflicts}
    )


def participant_out(p: Participant) -> ParticipantOut:
    """Convert a participant for the API."""
    return ParticipantOut(
        code=p.code,
        status=p.status,
        synthetic=p.synthetic,
        site=p.site.code,
        created_at=p.created_at,
        settings=SettingsOut.model_validate(p.current_settings),
    )


def visit_out(v: Visit, code: str) -> VisitOut:
    """Convert a visit for the API."""
    amplitudes = [{"hemisphere": a.hemisphere, "program": a.program, "amplitude_ma": a.amplitude_ma} for a in v.cdbs_amplitudes]
    return VisitOut.model_validate(
        {"id": v.id, "participant": code, "number": v.number, "date": v.date, "note": v.note or "", "cdbs_amplitudes": amplitudes}
    )


def lock_rows(db: Session, v: Visit) -> list[VisitLockOut]:
    """List the locks and unlocks of a visit for the API, oldest first, with the state of their signatures."""
    found = signatures_of_locks(db, v)
    return [
        VisitLockOut(
            locked=row.locked,
            reason=row.reason,
            created_at=row.created_at,
            created_by=row.created_by,
            signature=SignatureOut.model_validate(found[row.id][1]) if found[row.id][1] else None,
            signature_state=found[row.id][0],
        )
        for row in v.locks
    ]


def session_out(s: StudySession, caller: Caller) -> SessionOut:
    """Convert a session for the API; the controller comes through the blinding gate."""
    arm = blinding.visible_arm(s, caller)
    return SessionOut(
        id=s.id,
        visit_id=s.visit_id,
        visit=s.visit.number,
        participant=s.visit.participant.code,
        ordinal=s.ordinal,
        controller=arm.controller if arm else None,
        policy_id=arm.policy_id if arm else None,
        letter=s.letter,
        hemisphere=s.hemisphere,
        status=s.status,
        started_at=s.started_at,
        duration_s=s.duration_s,
        control_channel=s.control_channel,
        control_program=s.control_program,
        excluded_reason=s.excluded_reason,
        stopped_reason=s.stopped_reason,
        medication_h=s.medication_h,
        hours_since_dose=hours_since_dose(s),
        activity=s.activity,
        recordings=sorted({g.recording_id for g in s.segments}),
        qoc=QocOut.model_validate(s.qoc) if s.qoc else None,
    )


def trace_out(data: SessionData) -> TraceOut:
    """Convert a step table for the API."""
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


def recorded_trace_out(found: RecordedTrace) -> RecordedTraceOut:
    """Convert a trace of a recording for the API."""
    trace = found.trace
    return RecordedTraceOut(
        is_control=found.is_control,
        hemisphere=trace.recording.hemisphere,
        t_s=[round(t, 6) for t in found.t_s.tolist()],
        values=_nullable(found.values),
        **{n: getattr(trace, n) for n in ("id", "recording_id", "stream", "channel", "unit", "source", "decode_version", "details")},
    )


def _nullable(values: NDArray[np.float64]) -> list[float | None]:
    return [None if np.isnan(v) else float(v) for v in values]
