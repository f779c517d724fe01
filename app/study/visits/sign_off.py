"""What a clinician signs when a visit is locked, and whether the signature under the lock in force still stands. The caller commits."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from enum import Enum
from typing import Any, Final

from sqlalchemy.orm import Session

from app.accounts import sign_on
from app.accounts.permissions import SYSTEM, Caller
from app.platform.errors import Invalid
from app.platform.signatures import repository as signatures
from app.platform.signatures.service import SignatureState, content_hash, state_of
from app.study import repository
from app.study.blinding import stated_arm
from app.study.traces import sources
from app.tables.audit import Signature
from app.tables.sessions import StudySession
from app.tables.visits import Visit, VisitLock
from ml.outcomes import FIELDS

KIND: Final = "visit_lock"
MEANING: Final = "data of this visit are complete and reviewed"
_SESSION = (
    "ordinal", "hemisphere", "status", "started_at", "duration_s", "plan_item_id", "control_stream", "control_channel", "control_program",
    "excluded_reason", "stopped_reason", "medication_h", "activity",
)  # fmt: skip
_QOC = ("revision", *FIELDS, "derived", "entered_by", "reason")
_CONDITIONS = (
    "revision", "origin", "lower_bound", "window", "period_s", "xi_beta", "min_ma", "max_ma", "seed", "design", "design_parameters",
    "lead_amplitude_ma", "cdbs_amplitude_ma", "programming", "entered_by", "reason",
)  # fmt: skip


def sign_lock(db: Session, visit: Visit, lock: VisitLock, caller: Caller, password: str, code: str) -> Signature:
    """Sign a lock over the visit's data as they are. Raises as `app.accounts.sign_on.sign`."""
    content = signed_content(db, visit, lock)
    return sign_on.sign(db, caller, password, kind=KIND, subject_id=lock.id, meaning=MEANING, content=content, code=code)


def signatures_of_locks(db: Session, visit: Visit) -> dict[int, tuple[SignatureState, Signature | None]]:
    """For each lock and unlock of a visit, by its number: whether its signature stands, and the signature.

    Only the lock in force can stand or be broken: after an unlock the data may change.
    """
    found = signatures.newest_of_each(db, KIND, [row.id for row in visit.locks if row.locked])
    states: dict[int, tuple[SignatureState, Signature | None]] = {}
    for row in visit.locks:
        signature = found.get(row.id)
        if not row.locked:
            states[row.id] = SignatureState.NONE, None
        elif row is not visit.locks[-1]:
            states[row.id] = (SignatureState.ENDED if signature else SignatureState.NOT_KEPT), signature
        else:
            states[row.id] = _present(db, visit, row, signature), signature
    return states


def _present(db: Session, visit: Visit, lock: VisitLock, signature: Signature | None) -> SignatureState:
    return SignatureState.NOT_KEPT if signature is None else state_of(signature, signed_content(db, visit, lock))


def signed_content(db: Session, visit: Visit, lock: VisitLock) -> dict[str, Any]:
    """All that a signature under a lock covers: the visit, its doses, and of every session who says what, what it counts, and its samples.

    Samples are covered by the SHA-256 of what the newest reading of each recording gives, so that reading a file again with the same
    values changes nothing. The cDBS amplitude in force is covered beside the stated ones: where the visit states none it is that of the
    settings, and every fraction, energy and verdict goes by it.
    """
    sessions, _ = repository.sessions_of_visit(db, visit.id, 1000)
    used = {segment.recording_id for session in sessions for segment in session.segments}
    read = {number: _digest(traces) for number, traces in repository.traces_of_recordings(db, used).items()} if used else {}
    heads = repository.trace_heads(db, used) if used else {}
    return {
        "participant": visit.participant.code,
        "visit": visit.number,
        "date": visit.date.isoformat() if visit.date else None,
        "note": visit.note,
        "locked_by": lock.created_by,
        "lock_reason": lock.reason,
        "cdbs_amplitudes": sorted([str(a.hemisphere), a.program, a.amplitude_ma] for a in visit.cdbs_amplitudes),
        "doses": sorted([str(d.drug), d.mg, _plain(d.taken_at)] for d in visit.doses),
        "sessions": [_session(session, read) | {"cdbs_amplitude_in_force_ma": _cdbs_ma(session, heads)} for session in sessions],
    }


def _session(session: StudySession, read: dict[int, str]) -> dict[str, Any]:
    arm = stated_arm(session, SYSTEM)
    return _fields(session, _SESSION) | {
        "session": session.id,
        "controller": arm.controller.value if arm else None,
        "policy": arm.policy_id if arm else None,
        "qoc": _fields(session.qoc, _QOC) if session.qoc else None,
        "conditions": _fields(session.conditions, _CONDITIONS) if session.conditions else None,
        "recordings": [
            _fields(s, ("recording_id", "start_s", "stop_s", "is_control")) | {"samples": read.get(s.recording_id)}
            for s in sorted(session.segments, key=lambda s: (s.recording_id, s.start_s))
        ],
    }


def _cdbs_ma(session: StudySession, heads: Mapping[int, Sequence[repository.TraceHead]]) -> float | None:
    """What the session's amplitude is a fraction of, mA; None where nobody stated it, or nothing says which of several it is."""
    try:
        return sources(session, session.visit.participant.current_settings, heads).cdbs_ma
    except Invalid:
        return None


def _digest(traces: list[Any]) -> str:
    """SHA-256 of the traces of one reading of a recording."""
    return content_hash(
        {
            "traces": [
                [t.stream, t.channel, t.unit, t.source, t.dt_s, t.first_end_s, hashlib.sha256(t.values_f32).hexdigest(), t.valid_bits.hex()]
                for t in traces
            ]
        }
    )


def _fields(row: object, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: _plain(getattr(row, name)) for name in names}


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.astimezone(UTC).isoformat()
    return value.value if isinstance(value, Enum) else value
