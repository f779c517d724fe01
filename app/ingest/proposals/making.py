"""Sessions of what an upload brought: confirmed where the sender stated enough, else proposed, or joined to sessions that were there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta

from sqlalchemy.orm import Session

from app.ingest import repository, sessions, wording
from app.ingest.evidence import BY_UPLOAD, Evidence, Reason, Source, guess_visit
from app.ingest.proposals import control_channel, guesses
from app.ingest.proposals.guesses import differs_from_slot, visit_of_slot
from app.ingest.proposals.parts import placement_of
from app.ingest.proposals.service import renew
from app.ingest.sessions import Placement, StatedSession, add_session
from app.ingest.uploads import outcomes as outcomes_intake
from app.platform import numbers
from app.platform.database import now
from app.study import repository as study
from app.study.recordings import controller_log
from app.study.sessions import conditions
from app.study.sessions.contradictions import begins_later, contradictions, control_recording, local_day
from app.study.sessions.usable_steps import sentence, usable_steps
from app.study.sessions.wording import sentences
from app.tables.participants import Participant
from app.tables.recordings import Recording
from app.tables.sessions import StudySession
from app.tables.uploads import SessionProposal, Upload
from ml.formats.disagreements import CONFLICTS


@dataclass(frozen=True)
class NewSession:
    """A session that came out of an upload.

    Attributes:
        understood, flagged: sentences for the reports of its files.
    """

    session: StudySession
    recordings: list[Recording]
    understood: list[str]
    flagged: list[str]


def make_sessions(
    db: Session, participant: Participant, upload: Upload, recordings: Sequence[Recording], stated: StatedSession
) -> list[NewSession]:
    """Make sessions of recordings that have none: confirmed where the sender stated visit and controller and confirms them, else
    proposed."""
    usable = [r for r in recordings if sessions.makes_session(study.traces_of_recording(db, r.id), r)]
    groups = sessions.together(usable)
    return [_make(db, participant, upload, group, stated, alone=len(groups) == 1) for group in groups]


def _make(db: Session, participant: Participant, upload: Upload, group: list[Recording], stated: StatedSession, alone: bool) -> NewSession:
    if (joined := _join_earlier(db, participant, group, stated)) is not None:
        return joined
    placement = sessions.place(db, participant, group, stated, alone)
    if stated.counts and sessions.counted_minutes(db, placement):
        # what differs from a session that counts is for a person to look at
        stated = replace(stated, confirm=False)
    day = local_day(placement.control, placement.started_at) if placement.started_at else None
    slot = controller_log.slot_of_recording(db, placement.control)
    visits = study.visits(db, participant.id, 1000, 0)[0] if stated.visit is None or slot is not None else []
    if controller_log.rehearsed(placement.control) or sessions.invented(participant, group) or differs_from_slot(slot, stated):
        # a log of a bench, of a simulation, or of another session than the sender says, is for a person to look at
        stated = replace(stated, confirm=False)
    if begins_later(placement.started_at, now()) and not participant.synthetic:
        # a clock is wrong, and a person says which
        stated = replace(stated, confirm=False)
    if any(r.details.get("quality", {}).get(CONFLICTS) for r in group):
        # two sources differ about the amplitude: a person looks at both before the session counts
        stated = replace(stated, confirm=False)
    guess = visit_of_slot(visits, slot, stated.visit) or guess_visit(visits, day, stated.visit)
    session = add_session(db, guess.visit, placement, stated.controller, stated.policy_id, stated.hemisphere, stated.counts)
    guesses.policy_by_log(db, session)
    program = control_channel.choose_program(db, session)
    length = f"{numbers.stated(round(session.duration_s / 60, 1))} min" if session.duration_s else "no data"
    seen, usable = _seen(session, placement), sentence(usable_steps(db, session))
    if stated.counts:
        ran = wording.HIDDEN if session.visit.sealed else stated.controller
        said = f"Session {session.id}: visit {guess.visit.number}, {ran}, {length}, {seen} (recording {placement.control.id})."
        flagged = [*placement.notes, *sessions.fix_milliamperes(db, session), *sentences(contradictions(db, session))]
        conditions.record(db, session, upload.created_by)
        return NewSession(session, group, [said, usable, *outcomes_intake.derive(db, session)], flagged)
    evidence = {"visit": guess.why, "controller": BY_UPLOAD}
    controller = stated.controller
    if controller is None:
        guess_of_controller = guesses.controller(db, session)
        controller, evidence["controller"] = guess_of_controller.controller, guess_of_controller.why
        guess_of_controller.assign(session, stated.policy_id)
    of_recording = Evidence(Source.RECORDING, Reason.RECORDED_SIDE if session.hemisphere else Reason.NO_SIDE)
    evidence["hemisphere"] = BY_UPLOAD if stated.hemisphere else of_recording
    evidence["control"] = control_channel.why(db, session)
    evidence |= {"program": program} if program else {}
    proposal = SessionProposal(
        session_id=session.id,
        upload_id=upload.id,
        visit_open=guess.open,
        evidence={name: e.as_json() for name, e in evidence.items()},
        changed_by=upload.created_by,
        version=1,
    )
    db.add(proposal)
    db.flush()
    why = wording.reasons({name: e.as_json() for name, e in evidence.items()}, session.visit.sealed)
    ran = wording.HIDDEN if session.visit.sealed and controller else controller or "controller open"
    said = (
        f"Proposed session {session.id}, which counts nowhere until it is confirmed: "
        f"{'visit open' if guess.open else f'visit {guess.visit.number}'} ({why['visit']}), "
        f"{ran} ({why['controller']}), {length}, {seen}."
    )
    return NewSession(session, group, [said, usable], [*placement.notes, *sentences(contradictions(db, session, guess.open))])


def _seen(session: StudySession, placement: Placement) -> str:
    """Describe which trace of which side the controller is taken to have seen, in words."""
    trace = f"{session.control_stream.replace('_', ' ')} {session.control_channel or ''}".strip()
    others = [r for r in placement.recordings if r is not placement.control]
    side = (
        f" of the {placement.control.hemisphere} side"
        if placement.control.hemisphere
        else f" of recording {placement.control.id}"
        if others
        else ""
    )
    beside = [f"the {r.hemisphere} side" if r.hemisphere else f"recording {r.id}" for r in others]
    return f"controlled by {trace}{side}" + (f", recorded together with {' and '.join(beside)}" if beside else "")


def _join_earlier(db: Session, participant: Participant, group: list[Recording], stated: StatedSession) -> NewSession | None:
    """Find the sessions of earlier uploads that these recordings share their time with (the other implant came first), if there are any.

    A confirmed session gets them in addition to its controlled recording: nothing that counts changes.
    """
    first = group[0]
    if first.started_at is None:
        return None
    end = first.started_at + timedelta(seconds=first.duration_s)
    found: NewSession | None = None
    for session in repository.overlapping_sessions(db, participant.id, first.started_at, end):
        known = [s.recording for s in session.segments]
        if any(r.device_id == k.device_id for r in group for k in known) or len(sessions.together([*known, *group])) != 1:
            continue
        control = next(s for s in session.segments if s.is_control)
        placement = placement_of(session, control.start_s, control.stop_s)
        period_s = participant.current_settings.period_s
        added = [sessions.add_beside(session, r, placement, period_s) for r in group]
        if not any(added):
            continue
        db.flush()
        said, flagged = _joined(db, session, stated)
        found = NewSession(session, group, [], []) if found is None else found
        found.understood.append(said)
        found.flagged.extend(flagged)
    return found


def _joined(db: Session, session: StudySession, stated: StatedSession) -> tuple[str, list[str]]:
    """Report recordings that were added to an existing session, after their time."""
    differs = sessions.disagreements(db, [session.id], stated)
    if session.status == "confirmed":
        side = f" ({control_recording(session).hemisphere} side)" if control_recording(session).hemisphere else ""
        said = f"Recorded at the same time as session {session.id}, which counts already: added to it beside its controlled recording"
        return f"{said}{side}.", [*differs, *sentences(contradictions(db, session))]
    renew(db, session)
    proposal = repository.proposals(db, [session.id])[session.id]
    said = f"Recorded at the same time as proposed session {session.id}, which counts nowhere until it is confirmed"
    return f"{said}: it belongs to that session.", [*differs, *sentences(contradictions(db, session, proposal.visit_open))]
