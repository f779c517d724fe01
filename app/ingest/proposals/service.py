"""Proposed sessions, which `making` makes of an upload: corrected, cut, confirmed or dropped by a person. Nothing counts before that."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import SYSTEM, Caller
from app.ingest import repository, sessions, wording
from app.ingest.evidence import BY_CUT, Evidence, Reason, Source
from app.ingest.proposals import control_channel, guesses
from app.ingest.proposals.parts import choose_part, choose_side, on_grid, placement_of
from app.ingest.schemas import PartIn, ProposalChange
from app.ingest.sessions import add_session
from app.ingest.uploads import outcomes as outcomes_intake
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.study import access, blinding, data_queries
from app.study import repository as study
from app.study.recordings import amplitude_sources, controller_log
from app.study.recordings.amplitude_sources import AmplitudeChoice, AmplitudeConflictOut
from app.study.sessions import conditions
from app.study.sessions import wording as session_wording
from app.study.sessions.changes import POLICY_CONTROLLERS
from app.study.sessions.contradictions import contradictions, control_recording
from app.study.sessions.wording import sentences
from app.study.visits import require_unlocked
from app.tables.sessions import Controller, StudySession
from app.tables.uploads import SessionProposal

RESTS_ON = frozenset({"visit", "hemisphere", "start_s", "stop_s", "started_at", "controller"})
"""Fields of a correction after which a guessed controller is guessed again."""

PART = frozenset({"start_s", "stop_s", "started_at"})
"""Fields of a correction after which a control channel is chosen again, unless a person stated it."""


def _renew_guess(db: Session, session: StudySession, proposal: SessionProposal, keep: bool = False) -> None:
    """Guess the controller again after what the guess rests on has changed; what a person stated stays.

    Args:
        keep: leave the controller, which a person confirms unchanged, and renew the reason alone.
    """
    if "controller" in proposal.evidence and Evidence.from_json(proposal.evidence["controller"]).stated:
        return
    arm = blinding.stated_arm(session, SYSTEM)
    guess = guesses.controller(db, session)
    proposal.evidence = {**proposal.evidence, "controller": guess.why.as_json()}
    if not keep and guess.controller != (arm.controller if arm else None):
        guess.assign(session, arm.policy_id if arm else None)


def renew(db: Session, session: StudySession) -> None:
    """Update a proposal after its recordings changed: its guess is made again, and open forms do not overwrite it."""
    proposal = repository.proposals(db, [session.id])[session.id]
    proposal.version += 1
    _renew_guess(db, session, proposal)
    db.flush()


def change(db: Session, session: StudySession, wanted: ProposalChange, caller: Caller) -> SessionProposal:
    """Correct a proposal; omitted fields stay.

    Raises:
        Conflict: it was confirmed, or changed after the caller looked at it. Invalid: a value that cannot be.
    """
    return _correct(db, session, wanted, caller, confirming=False)


def _correct(db: Session, session: StudySession, wanted: ProposalChange, caller: Caller, confirming: bool) -> SessionProposal:
    proposal = locked(db, session, wanted.version, caller)
    given = wanted.model_dump(exclude_unset=True, exclude={"version", "reason"})
    set_reason(db, wanted.reason)
    _move_to_visit(db, session, proposal, given)
    _name_controller(db, session, given, caller)
    if "hemisphere" in given:
        choose_side(db, session, given)
    if {"control_stream", "control_channel", "control_program"} & given.keys():
        control_channel.choose(db, session, given)
    if PART & given.keys():
        choose_part(session, given)
    stated = {name: _by(caller) for name in ("visit", "controller", "hemisphere") if given.get(name) is not None}
    if "controller" in given and given["controller"] is None:
        stated["controller"] = _by(caller, open=True)
    if given.get("control_stream") is not None or given.get("control_channel") is not None:
        stated["control"] = _by(caller)
    elif "hemisphere" in given:
        stated["control"] = control_channel.why(db, session)
    proposal.evidence = {**proposal.evidence, **{name: e.as_json() for name, e in stated.items()}}
    if given.get("control_program") is not None:
        proposal.evidence = {**proposal.evidence, "program": _by(caller).as_json()}
    if PART & given.keys():
        db.flush()
        proposal.evidence = control_channel.renewed(db, session, proposal.evidence)
    if RESTS_ON & given.keys():
        db.flush()
        proposal.evidence = control_channel.renewed_program(db, session, proposal.evidence)
        _renew_guess(db, session, proposal, keep=confirming)
    proposal.version += 1
    proposal.changed_by = caller.label
    db.flush()
    return proposal


def _by(caller: Caller, **facts: bool) -> Evidence:
    """Make the evidence of the person who corrects a proposal."""
    return Evidence(Source.PERSON, Reason.STATED, {"by": caller.label, **facts})


def confirm(db: Session, session: StudySession, wanted: ProposalChange, caller: Caller) -> list[str]:
    """Correct a proposal and let it count from now on.

    Returns:
        Sentences: contradictions with its amplitudes, and what was derived for it from files of outcomes.

    Raises:
        Conflict: as `change`, or another confirmed session counts on the same stretch. Invalid: visit or controller is still open.
    """
    proposal = _correct(db, session, wanted, caller, confirming=True)
    missing = [name for name, open_ in (("visit", proposal.visit_open), ("controller", not blinding.is_stated(session))) if open_]
    if missing:
        known = wording.reasons(proposal.evidence, session.visit.sealed)
        why = "; ".join(f"{name}: {known.get(name, 'nobody stated it')}" for name in missing)
        raise Invalid(
            f"Session {session.id} cannot be confirmed yet: its {' and '.join(missing)} is open ({why}).", "State it.", field=missing[0]
        )
    require_unlocked(session.visit)
    amplitude_sources.refuse_open(session)
    sessions.refuse_overlap(db, session)
    sessions.count(db, session)
    kept_as_fractions = sessions.fix_milliamperes(db, session)
    conditions.record(db, session, caller.label)
    return [
        *_exclude_where_not_run(session),
        *kept_as_fractions,
        *sentences(contradictions(db, session)),
        *outcomes_intake.derive(db, session),
    ]


def _exclude_where_not_run(session: StudySession) -> list[str]:
    """Exclude a session in which its policy or schedule decided too seldom. Returns the reason, a sentence, where it did."""
    share = controller_log.policy_share(control_recording(session)) if session.segments else None
    if share is None or share >= controller_log.LEAST_SHARE or session.excluded_reason is not None:
        return []
    session.excluded_reason = session_wording.seldom_decided(share, controller_log.LEAST_SHARE)
    return [session_wording.excluded_as_seldom_decided(session.id, session.excluded_reason)]


def choose_amplitude(
    db: Session, session: StudySession, version: int, choice: AmplitudeChoice, caller: Caller
) -> list[AmplitudeConflictOut]:  # fmt: skip
    """Let one of the sources of the amplitude count that differ, and guess again what rests on it. Raises Conflict as `change`; Invalid."""
    locked(db, session, version, caller)
    found = amplitude_sources.choose(db, session, choice, caller)
    renew(db, session)
    return found


def split(db: Session, session: StudySession, version: int, parts: Sequence[PartIn], caller: Caller) -> list[StudySession]:
    """Replace one proposal by several: a part of the same recordings each.

    Raises:
        Conflict: as `change`, or a data query is about it. Invalid: parts outside the recording or over each other.
    """
    proposal = locked(db, session, version, caller)
    _refuse_asked_about(db, session, "cut")
    spans = sorted((p.start_s, p.stop_s) for p in parts)
    for (_, stop), (start, _) in pairwise(spans):
        if start < stop - 1e-6:
            raise Invalid(f"Two parts share the time from {start:g} to {stop:g} s.", "Let each part begin where the one before has ended.")
    arm = blinding.stated_arm(session, SYSTEM)  # a guess that finds the same controller keeps its policy, which is not shown
    made = []
    for part in sorted(parts, key=lambda p: p.start_s):
        placement = placement_of(session, *on_grid(session, part.start_s, part.stop_s))
        new = add_session(db, session.visit, placement, part.controller, None, session.hemisphere, counts=False)
        new.control_program = session.control_program
        why = BY_CUT
        if part.controller is None:
            guess = guesses.controller(db, new)
            guess.assign(new, arm.policy_id if arm and guess.controller == arm.controller else None)
            why = guess.why
        part_of = Evidence(Source.CUT, Reason.CUT_OUT, {"session": session.id})
        evidence = {**control_channel.renewed(db, new, proposal.evidence), "controller": why.as_json(), "part": part_of.as_json()}
        db.add(
            SessionProposal(
                session_id=new.id,
                upload_id=proposal.upload_id,
                visit_open=proposal.visit_open,
                evidence=evidence,
                changed_by=caller.label,
                version=1,
            )
        )
        made.append(new)
    set_reason(db, f"cut into sessions {', '.join(str(s.id) for s in made)}")
    _delete(db, session)
    return made


def discard(db: Session, session: StudySession, version: int, reason: str, caller: Caller) -> None:
    """Drop a proposal that is no session; its recordings stay. Raises Conflict as `change`, or where a data query is about it."""
    locked(db, session, version, caller)
    _refuse_asked_about(db, session, "dropped")
    set_reason(db, reason)
    _delete(db, session)


def _refuse_asked_about(db: Session, session: StudySession, done: str) -> None:
    """Raise Conflict where a data query, closed or not, is about the proposal: it would be about nothing."""
    asked = data_queries.numbers_of_session(db, session.id)
    if asked:
        one = len(asked) == 1
        which = f"data {'query' if one else 'queries'} {', '.join(map(str, asked))}"
        raise Conflict(
            f"Session {session.id} cannot be {done}: {which} {'is' if one else 'are'} about it and would be about nothing.",
            "Correct it and confirm it; a confirmed session that is not to count is excluded with a reason.",
        )


def _delete(db: Session, session: StudySession) -> None:
    """Delete a session that was never confirmed; the trail keeps it, and its tests stay as removed rows."""
    outcomes_intake.give_up(db, session)
    db.delete(session)
    db.flush()


def locked(db: Session, session: StudySession, version: int, caller: Caller) -> SessionProposal:
    """Lock the proposal's row for a change. Raises Conflict where it was confirmed, or changed after the caller looked at it."""
    access.require(caller, can.WRITE_STUDY, session.visit.participant)
    proposal = repository.proposal(db, session.id, caller, lock=True)
    db.refresh(session, ["status"])
    if session.status != "proposed":
        raise Conflict(f"Session {session.id} was confirmed meanwhile.", "Correct it on its own page.")
    if proposal.version != version:
        what = f"Proposed session {session.id} was changed by {proposal.changed_by} after this form was opened; nothing was saved."
        way = "What you typed is still in the form: send it again to replace what is stored, or load the page again to keep that."
        raise Conflict(what, way, version=proposal.version)
    return proposal


def _move_to_visit(db: Session, session: StudySession, proposal: SessionProposal, given: dict[str, object]) -> None:
    number = given.get("visit")
    if not isinstance(number, int):
        return
    participant = session.visit.participant
    visit = study.visit_by_number(db, participant.id, number)
    if visit is None:
        raise Invalid(f"Participant {participant.code} has no visit {number}.", "Add the visit first.", field="visit")
    slot = controller_log.slot_of_recording(db, control_recording(session))
    if slot is not None and slot.planned is not None and slot.planned.sealed and visit.id not in (session.visit_id, slot.planned.visit_id):
        raise Conflict(
            f"Session {session.id} stays at its visit. Its log is of a session of visit {slot.visit_number}, whose plan's key is sealed; "
            f"visit {number} would show what ran.",
            "A clinician opens the key on the page of the plan; then it can be moved.",
            field="visit",
        )
    if visit.id != session.visit_id:
        session.ordinal = study.next_ordinal(db, visit.id)
        session.visit = visit
    proposal.visit_open = False


def _name_controller(db: Session, session: StudySession, given: dict[str, object], caller: Caller) -> None:
    if not {"controller", "policy"} & given.keys():
        return
    if "controller" not in given:
        blinding.require_known(session.visit, caller)  # what a policy alone is refused for would reveal the controller
    arm = blinding.stated_arm(session, SYSTEM)
    wanted = given.get("controller", arm.controller if arm else None)
    controller = Controller(str(wanted)) if wanted else None
    name = str(given["policy"] or "") if "policy" in given else None
    participant = session.visit.participant
    if name is None:
        policy_id = arm.policy_id if arm and controller in POLICY_CONTROLLERS else None
    else:
        policy_id = study.policy_id(db, participant.id, name) if name else None
        if name and policy_id is None:
            hint = "Give the name or number of one of its policies."
            raise Invalid(f"Participant {participant.code} has no policy '{name}'.", hint, field="policy")
    if policy_id is not None and controller not in POLICY_CONTROLLERS:
        what = f"A {controller or ''} session has no policy.".replace("  ", " ")
        raise Invalid(what, "Leave the policy empty, or name the controller.", field="policy")
    blinding.assign(session, controller, policy_id)
