"""Rules of the study; no HTTP, no SQL. The caller commits."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any, Protocol

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Invalid, NotFound
from app.study import blinding, repository
from app.study.outcomes import service as outcomes
from app.study.schemas import CdbsAmplitudeModel, DerivedChoice, QocIn, SessionChange, VisitChange, VisitIn
from app.study.sessions import repeated
from app.study.sessions.repository import other_values
from app.study.settings.schemas import SettingsIn
from app.study.threshold import MDP_FIELDS
from app.study.traces import NO_CONTROL, control_programs
from app.study.usual import questions
from app.study.usual.values import Question, question
from app.study.visits.service import require_unlocked
from app.tables.accounts import Site
from app.tables.outcomes import QocRevision
from app.tables.participants import Participant, SettingsVersion
from app.tables.sessions import Controller, StudySession
from app.tables.visits import CdbsAmplitude, Visit
from ml.mdp import MdpSettings
from ml.outcomes import FIELDS, OUTCOMES, enumerated

WITHDRAWN = "withdrawn"
NOT_AFTER_WITHDRAWAL = frozenset(
    {can.UPLOAD, can.RUN_JOBS, can.WRITE_POLICIES, can.DRAFT_PLAN, can.TAKE_BUNDLES, can.WRITE_SETTINGS}
    | {can.SIGN_PLAN, can.RELEASE, can.DECIDE_GATE, can.CLEAR_EVENT, can.SET_MARGINS}
)
"""What needs a participant who takes part. Records that exist may still be corrected, and a key be opened in an emergency."""
SIGNED_UNITS = {"dB", "z"}
"""Units in which a beta may be negative: logarithms and standard scores."""
POLICY_CONTROLLERS = {Controller.RL, Controller.DISTILLED, Controller.OTHER}
"""Controllers that a policy can stand behind."""


def change_settings(
    db: Session, participant: Participant, change: SettingsIn, reason: str | None, caller: Caller, sure: Collection[str] | None = None
) -> SettingsVersion:
    """Make a new settings version of what the change names; old results keep theirs. No change, no version.

    Raises Unusual for a value outside the usual whose name is not among `sure`; without a `sure` nothing is asked.
    """
    require(caller, can.WRITE_SETTINGS, participant)
    current = participant.current_settings
    values = {name: getattr(current, name) for name in SettingsIn.model_fields} | change.model_dump(exclude_unset=True)
    if all(getattr(current, name) == value for name, value in values.items()):
        return current
    questions.require_sure(change.model_dump(exclude_unset=True), sure, current)
    return add_settings(db, participant, values, caller, reason)


def withdrawn_codes(participants: Iterable[Participant]) -> frozenset[str]:
    """Codes of those among participants who have withdrawn, for lists that mark them."""
    return frozenset(p.code for p in participants if p.status == WITHDRAWN)


def add_visit(db: Session, participant: Participant, draft: VisitIn, caller: Caller) -> Visit:
    """Add a visit. Raises Conflict when its number is taken, Unusual for an amplitude outside the usual that nobody has confirmed."""
    require(caller, can.WRITE_STUDY, participant)
    if repository.visit_by_number(db, participant.id, draft.number):
        raise Conflict(f"Participant {participant.code} already has a visit {draft.number}.", "Choose the next number.", field="number")
    _each_once(draft.cdbs_amplitudes)
    questions.refuse(q for a in draft.cdbs_amplitudes if (q := _asked(a)))
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
        questions.refuse(q for a in wanted if (a.hemisphere, a.program, a.amplitude_ma) not in standing and (q := _asked(a)))
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
        raise Invalid("The same hemisphere and program stand twice in cdbs_amplitudes.", "Give each once.")


def _asked(amplitude: CdbsAmplitudeModel) -> Question | None:
    """What there is to ask about an amplitude of a visit; None where it is usual, or nobody can be asked."""
    asked = question("cdbs_amplitude_ma", amplitude.amplitude_ma)
    if asked is None or amplitude.sure is None:
        return None
    side, program = amplitude.hemisphere.value, amplitude.program
    return replace(asked, field="cdbs_amplitudes", hemisphere=side, program=program, confirmed=amplitude.sure)


def record_qoc(db: Session, session: StudySession, values: QocIn, caller: Caller) -> QocRevision:
    """Enter or correct QoCs: a new revision that keeps what the call leaves out. Same values, no revision.

    Raises Unusual for values outside the usual that nobody has confirmed.
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
    questions.require_sure(given, values.sure, known, others)
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
        repeated.refuse(db, session)
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
        raise Conflict(
            f"Session {session.id} is a proposal that nobody has confirmed yet.", "Confirm or correct it among the proposals first."
        )


def _check_policy(db: Session, session: StudySession, controller: Controller, policy_id: int | None) -> None:
    participant = session.visit.participant
    if policy_id is None:
        return
    if controller not in POLICY_CONTROLLERS:
        raise Invalid(f"A {controller} session has no policy.", "Leave the policy empty, or correct the controller.")
    if not repository.has_policy(db, participant.id, policy_id):
        raise Invalid(f"Participant {participant.code} has no policy {policy_id}.", "Name one of this participant's policies.")


def check_control(db: Session, session: StudySession, given: dict[str, Any]) -> None:
    """A session can only be controlled by a trace, and through a program, that one of its recordings has."""
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


def require(caller: Caller, permission: str, participant: Participant) -> None:
    """Raises NotFound or Forbidden unless the caller holds the permission for this participant.

    Raises Conflict where it would be new work for a participant who has withdrawn.
    """
    caller.require(permission, participant.site.study_id, participant.site_id)
    if caller.is_system and permission not in can.AFTER_END:
        refuse_ended_study(participant.site)
    if permission in NOT_AFTER_WITHDRAWAL:
        refuse_withdrawn(participant)


def refuse_withdrawn(participant: Participant) -> None:
    """Raises Conflict for new work for a participant who has withdrawn."""
    if participant.status == WITHDRAWN:
        raise Conflict(
            f"Participant {participant.code} has withdrawn from the study: nothing new is recorded, computed or planned.",
            "What is there can be read and exported. A mistake is taken back on the participant's page.",
        )


def require_still_taking_part(db: Session, participant: Participant) -> None:
    """Raises Conflict where the participant has withdrawn, or the study has ended, since the caller was judged.

    Neither happens from here to the end of the transaction: whoever withdraws or ends waits for it, and sees what it made.
    """
    repository.hold_participation(db, participant)
    refuse_ended_study(participant.site)
    refuse_withdrawn(participant)


def refuse_ended(site: Site) -> None:
    """Raises Conflict for new participants and new data of a site or a study that has ended."""
    if site.ended_at is not None:
        raise Conflict(
            f"Site '{site.code}' has ended: nobody is enrolled there and nothing is uploaded.",
            "An administrator of the study can open it again.",
        )
    refuse_ended_study(site)


def refuse_ended_study(site: Site) -> None:
    """Raises Conflict for any change in a study that has ended: to people it is refused with their roles (`Grant.holds`)."""
    if site.study.ended_at is not None:
        raise Conflict(f"Study '{site.study.code}' has ended: it is read and exported, and nothing in it changes.", can.STUDY_ENDED_HINT)


def may(caller: Caller, permission: str, participant: Participant) -> bool:
    """Whether the caller holds the permission for this participant: for pages that leave out what would be refused."""
    return caller.may(permission, participant.site.study_id, participant.site_id)


class Owned(Protocol):
    """A row of one participant."""

    @property
    def participant_id(self) -> int | None:
        """Whose it is."""


def require_own(participant: Participant, row: Owned, name: str) -> None:
    """Objects that are named together belong together.

    Args:
        participant: whose object it should be. row: the object. name: what to call it, e.g. "policy 7".

    Raises:
        NotFound: it is another participant's.
    """
    if row.participant_id != participant.id:
        raise NotFound(f"Participant {participant.code} has no {name}.", "Choose one from the participant's own list.")


def add_settings(db: Session, participant: Participant, values: dict[str, Any], caller: Caller, reason: str | None) -> SettingsVersion:
    """Store the next settings version. Raises Invalid for settings that contradict each other, Conflict where somebody was faster."""
    try:
        MdpSettings(xi_beta=values["xi_beta"] if values["xi_beta"] is not None else 0.0, **{n: values[n] for n in MDP_FIELDS})
    except ValueError as error:
        raise Invalid(f"{error}.", "Correct the settings.") from error
    xi_beta, unit = values["xi_beta"], values["beta_unit"]
    if xi_beta is not None and xi_beta <= 0 and unit not in SIGNED_UNITS:
        raise Invalid(
            f"A beta threshold of {xi_beta:g} {unit or ''} cannot be: an amplitude or a power is positive.".replace("  ", " "),
            f"Give one above 0, or state the unit of a beta that may be negative: {', '.join(sorted(SIGNED_UNITS))}.",
        )
    if values["beta_low_hz"] >= values["beta_high_hz"]:
        raise Invalid(
            f"The beta band {values['beta_low_hz']:g}-{values['beta_high_hz']:g} Hz is empty.", "Set beta_low_hz below beta_high_hz."
        )
    row = SettingsVersion(
        participant_id=participant.id, version=len(participant.settings) + 1, created_by=caller.label, reason=reason, **values
    )
    set_reason(db, reason)
    participant.settings.append(row)
    try:
        db.flush()
    except IntegrityError as error:
        db.rollback()
        raise Conflict("Somebody else changed these settings at the same time.", "Load them again and repeat your change.") from error
    return row
