"""Visits: their pages and the form that corrects one."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from enum import Enum
from typing import Any, Final

from fastapi import Request
from fastapi.responses import HTMLResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts import sign_on
from app.accounts.permissions import SYSTEM, Caller
from app.platform.audit import signatures
from app.platform.audit.signatures import SignatureState, content_hash, state_of
from app.platform.database import now, set_reason
from app.platform.errors import BetaloopError, Conflict, Invalid
from app.platform.web.forms import field_notes
from app.platform.web.templates import render
from app.study import repository
from app.study.access import may, require
from app.study.blinding import Arm, stated_arm, visible_arms
from app.study.outcome_fields import Question, question, refuse
from app.study.schemas import CdbsAmplitudeModel, VisitChange, VisitIn
from app.study.traces import sources
from app.tables.audit import Signature
from app.tables.participants import Participant
from app.tables.sessions import StudySession
from app.tables.visits import CdbsAmplitude, Visit, VisitLock
from ml.outcomes import FIELDS

# Lock and unlock a visit: closed for changes, open to blinded assessors. The caller commits.

Day = tuple[Visit, list[tuple[StudySession, Arm | None]]]


def days_of(visits: Sequence[Visit], sessions: Sequence[StudySession], caller: Caller) -> list[Day]:
    """Group sessions by visit in order, each with its arm as far as the caller may know it."""
    found: dict[int, list[tuple[StudySession, Arm | None]]] = {v.id: [] for v in visits}
    for session, arm in zip(sessions, visible_arms(sessions, caller), strict=True):
        found.get(session.visit_id, []).append((session, arm))
    return [(v, found[v.id]) for v in visits]


def lock(db: Session, visit: Visit, reason: str, caller: Caller, password: str, code: str = "") -> VisitLock:
    """Close the data of a visit, signed over what they are.

    Args:
        password: of the caller, asked for again; empty where a fresh sign-on replaces it. code: of the second factor.

    Raises:
        Conflict: it is locked already, or sessions wait for confirmation. Invalid: no reason. Forbidden, TooMany: as
            `app.accounts.sign_on`.
    """
    waiting = [s for s in repository.proposals_of_participant(db, visit.participant_id) if s.visit_id == visit.id]
    if waiting:
        raise Conflict(
            f"Visit {visit.number} has {len(waiting)} proposed session(s) that are not confirmed.", "Confirm or discard them, then lock."
        )
    row = _set(db, visit, True, reason, caller)
    sign_lock(db, visit, row, caller, password, code)
    return row


def unlock(db: Session, visit: Visit, reason: str, caller: Caller) -> VisitLock:
    """Open the data of a visit again. Raises Conflict where it is not locked, Invalid without a reason."""
    return _set(db, visit, False, reason, caller)


def require_unlocked(visit: Visit) -> None:
    """Raise Conflict where a visit is locked."""
    if visit.locked:
        last = visit.locks[-1]
        raise Conflict(
            f"Visit {visit.number} was locked by {last.created_by} on {last.created_at:%Y-%m-%d %H:%M} UTC; nothing was changed.",
            "A clinician unlocks it first, with a reason.",
        )


def _set(db: Session, visit: Visit, locked: bool, reason: str, caller: Caller) -> VisitLock:
    site = visit.participant.site
    caller.require(can.LOCK_VISIT, site.study_id, site.id)
    if not reason.strip():
        raise Invalid("A reason is missing.", "Say why; it is kept with the lock.")
    repository.lock_row(db, visit)
    if visit.locked is locked:
        raise Conflict(f"Visit {visit.number} is {'locked already' if locked else 'not locked'}.", "Load the page again.")
    set_reason(db, reason.strip())
    held = visit.participant.current_settings.id if locked else None
    row = VisitLock(visit_id=visit.id, locked=locked, reason=reason.strip(), created_by=caller.label, settings_version_id=held)
    visit.locks.append(row)
    db.flush()
    return row


# A visit as a blinded assessor sees it: its sessions with their QoCs, and nothing that gives the controllers away.


def blinded_page(
    request: Request,
    db: Session,
    visit: Visit,
    caller: Caller,
    error: BetaloopError | None = None,
    refused: StudySession | None = None,
    typed: Mapping[str, str] | None = None,
) -> HTMLResponse:
    """Render the page; `refused` is the session whose form was refused, and `typed` its content."""
    sessions, _ = repository.sessions_of_visit(db, visit.id)
    page = render(
        request,
        "study/visits/visit_blinded.html",
        visit=visit,
        participant=visit.participant,
        sessions=sessions,
        may_rate=may(caller, can.WRITE_QOC, visit.participant),
        refused=refused.id if refused else None,
        typed=typed or {},
        remarks=field_notes(error, typed or {}),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)


# What a clinician signs when a visit is locked, and whether the signature under the lock in force is still valid. The caller commits.

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
    """Return, for each lock and unlock of a visit by its number, the state of its signature, and the signature.

    Only the lock in force can be valid or broken: after an unlock the data may change.
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
    """Build the signed content of a lock: the visit, its doses, and of every session its source, its counts and its samples.

    Samples are covered by the SHA-256 of each recording's newest reading: reading a file again with the same values changes nothing. The
    cDBS amplitude in force is covered besides the stated ones. Where the visit states none it is that of the settings, and every fraction,
    energy and verdict uses it.
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
    """Return the reference of the session's amplitude, mA; None where none is stated, or where several are and none is chosen."""
    try:
        return sources(session, session.visit.participant.current_settings, heads).cdbs_ma
    except Invalid:
        return None


def _digest(traces: list[Any]) -> str:
    """Hash the traces of one reading of a recording by SHA-256."""
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


# Rules of entering and correcting a visit.


def add_visit(db: Session, participant: Participant, draft: VisitIn, caller: Caller) -> Visit:
    """Add a visit. Raises Conflict when its number is taken, Unusual for an amplitude outside the usual that is not confirmed."""
    require(caller, can.WRITE_STUDY, participant)
    if repository.visit_by_number(db, participant.id, draft.number):
        raise Conflict(f"Participant {participant.code} already has a visit {draft.number}.", "Choose the next number.", field="number")
    _each_once(draft.cdbs_amplitudes)
    refuse(q for a in draft.cdbs_amplitudes if (q := _asked(a)))
    visit = Visit(participant_id=participant.id, number=draft.number, date=draft.date, note=draft.note)
    visit.cdbs_amplitudes = [CdbsAmplitude(**a.model_dump(exclude={"sure"})) for a in draft.cdbs_amplitudes]
    db.add(visit)
    db.flush()
    return visit


def change_visit(db: Session, visit: Visit, change: VisitChange, caller: Caller) -> Visit:
    """Correct a visit's date, note or cDBS amplitudes; its sessions' fractions follow, the audit trail keeps what stood before and why."""
    require(caller, can.WRITE_STUDY, visit.participant)
    require_unlocked(visit)
    set_reason(db, change.reason)
    given = change.model_fields_set
    if "date" in given:
        visit.date = change.date
    if "note" in given:
        visit.note = change.note or ""
    if "cdbs_amplitudes" in given:
        wanted = change.cdbs_amplitudes or []
        _each_once(wanted)
        standing = {(a.hemisphere, a.program, a.amplitude_ma) for a in visit.cdbs_amplitudes}
        refuse(q for a in wanted if (a.hemisphere, a.program, a.amplitude_ma) not in standing and (q := _asked(a)))
        stated = {(a.hemisphere, a.program): a.amplitude_ma for a in wanted}
        for row in list(visit.cdbs_amplitudes):
            amplitude = stated.pop((row.hemisphere, row.program), None)
            if amplitude is None:
                row.removed_at = now()
            else:
                row.amplitude_ma = amplitude
        visit.cdbs_amplitudes += [CdbsAmplitude(hemisphere=h, program=p, amplitude_ma=ma) for (h, p), ma in stated.items()]
    db.flush()
    db.refresh(visit, ["cdbs_amplitudes"])
    return visit


def _each_once(amplitudes: Sequence[CdbsAmplitudeModel]) -> None:
    keys = [(a.hemisphere, a.program) for a in amplitudes]
    if len(set(keys)) < len(keys):
        raise Invalid("The same hemisphere and program are twice in cdbs_amplitudes.", "Give each once.")


def _asked(amplitude: CdbsAmplitudeModel) -> Question | None:
    """Return the question about an amplitude of a visit; None where it is usual, or no person can be asked."""
    asked = question("cdbs_amplitude_ma", amplitude.amplitude_ma)
    if asked is None or amplitude.sure is None:
        return None
    side, program = amplitude.hemisphere.value, amplitude.program
    return replace(asked, field="cdbs_amplitudes", hemisphere=side, program=program, confirmed=amplitude.sure)
