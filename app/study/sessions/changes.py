"""Rules of correcting a session and of entering its outcomes."""

from __future__ import annotations

from typing import Any

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.study import blinding, repository
from app.study.access import require
from app.study.outcome_fields import require_sure
from app.study.outcomes import service as outcomes
from app.study.schemas import DerivedChoice, QocIn, SessionChange
from app.study.sessions import designs
from app.study.sessions.repository import other_values
from app.study.traces import NO_CONTROL, control_programs
from app.study.visits import require_unlocked
from app.tables.outcomes import QocRevision
from app.tables.sessions import Controller, StudySession
from ml.outcomes import FIELDS, OUTCOMES, enumerated

POLICY_CONTROLLERS = {Controller.RL, Controller.DISTILLED, Controller.OTHER}
"""Controllers that may run a policy."""


def record_qoc(db: Session, session: StudySession, values: QocIn, caller: Caller) -> QocRevision:
    """Enter or correct QoCs: a new revision that keeps what the call omits. Same values, no revision.

    Raises Unusual for values outside the usual that are not confirmed.
    """
    require(caller, can.WRITE_QOC, session.visit.participant)
    _refuse_proposal(session)
    require_unlocked(session.visit)
    repository.lock_session(db, session)
    known = session.qoc
    given = values.model_dump(exclude_unset=True, exclude={"reason", "sure"})
    merged = {name: getattr(known, name, None) for name in FIELDS} | given
    if known is not None and all(getattr(known, name) == value for name, value in merged.items()):
        return known
    if known is None and all(value is None for value in merged.values()):
        raise Invalid("No outcome was given.", f"Enter at least one of {enumerated([o.label.lower() for o in OUTCOMES])}.")
    others = {o.field: other_values(db, session, o) for o in OUTCOMES if o.far is not None}
    require_sure(given, values.sure, known, others)
    same = {name for name, value in merged.items() if value == getattr(known, name, None)}
    kept = [name for name in (known.derived if known else ()) if name in same]
    followed = [name for name in (known.from_day if known else ()) if name in same]
    return outcomes.add_revision(db, session, given, caller.label, values.reason, kept, followed)


def take_derived(db: Session, session: StudySession, choice: DerivedChoice, caller: Caller) -> QocRevision:
    """Put a derived QoC in the place of a typed one. Raises Invalid where the files give another value by now."""
    require(caller, can.WRITE_STUDY, session.visit.participant)
    _refuse_proposal(session)
    require_unlocked(session.visit)
    return outcomes.take_derived(db, session, choice.name, choice.value, caller.label)


def change_session(db: Session, session: StudySession, change: SessionChange, caller: Caller) -> StudySession:
    """Correct a session; the audit trail keeps what stood before and why."""
    require(caller, can.WRITE_STUDY, session.visit.participant)
    _refuse_proposal(session)
    require_unlocked(session.visit)
    given = change.model_dump(exclude_unset=True, exclude={"reason"})
    set_reason(db, change.reason)
    if "controller" in given or "policy_id" in given:
        arm = blinding.arm(session, caller)
        controller = given.pop("controller", None) or arm.controller
        kept = arm.policy_id if controller in POLICY_CONTROLLERS else None
        policy_id = given.pop("policy_id", kept)
        _check_policy(db, session, controller, policy_id)
        blinding.assign(session, controller, policy_id)
    check_control(db, session, given)
    if "excluded_reason" in given and not (given["excluded_reason"] or "").strip() and session.excluded_reason is not None:
        designs.refuse(db, session)
    stopped_before = session.stopped_reason
    for name, value in given.items():
        if name in ("excluded_reason", "stopped_reason"):
            value = (value or "").strip() or None
        elif name == "control_stream" and value is None:
            continue
        setattr(session, name, value)
    db.flush()
    outcomes.follow_stop(db, session, stopped_before, change.reason or "", caller)
    if "hemisphere" in given:
        outcomes.derive_for_session(db, session)  # another hand's grasps may count now
    return session


def _refuse_proposal(session: StudySession) -> None:
    if session.status == "proposed":
        raise Conflict(f"Session {session.id} is a proposal that is not confirmed yet.", "Confirm or correct it among the proposals first.")


def _check_policy(db: Session, session: StudySession, controller: Controller, policy_id: int | None) -> None:
    participant = session.visit.participant
    if policy_id is None:
        return
    if controller not in POLICY_CONTROLLERS:
        raise Invalid(f"A {controller} session has no policy.", "Leave the policy empty, or correct the controller.")
    if not repository.has_policy(db, participant.id, policy_id):
        raise Invalid(f"Participant {participant.code} has no policy {policy_id}.", "Name one of this participant's policies.")


def check_control(db: Session, session: StudySession, given: dict[str, Any]) -> None:
    """Require that the control trace, and the program, are of one of the session's recordings."""
    _check_program(db, session, given.get("control_program"))
    if given.get("control_stream") is None and given.get("control_channel") is None:
        return
    stream = given.get("control_stream") or session.control_stream
    channel = given.get("control_channel", session.control_channel)
    traces = [t for s in session.segments for t in repository.traces_of_recording(db, s.recording_id) if t.stream not in NO_CONTROL]
    if not any(t.stream == stream and channel in (None, t.channel) for t in traces):
        known = "; ".join(sorted({f"{t.stream} {t.channel}".strip() for t in traces})) or "none"
        raise Invalid(f"The session's recordings have no trace '{stream} {channel or ''}'.", f"Choose one of: {known}.")


def _check_program(db: Session, session: StudySession, program: int | None) -> None:
    if program is None:
        return
    known = control_programs(db, session)
    if program not in known:
        named = ", ".join(map(str, known)) or "none"
        raise Invalid(f"The session's control recording has no amplitude of program {program}.", f"Choose one of: {named}.")
