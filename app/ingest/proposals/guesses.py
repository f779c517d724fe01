"""Guesses of a proposed session: its controller, from its recordings, and its visit, from the slot that its log names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.ingest.evidence import Evidence, Reason, Source, VisitGuess, guess_controller
from app.ingest.proposals import control_channel
from app.ingest.sessions import StatedSession
from app.platform.errors import Invalid
from app.study import blinding
from app.study.recordings import controller_log
from app.study.recordings.controller_log import LoggedSlot
from app.study.sessions.changes import POLICY_CONTROLLERS
from app.study.sessions.contradictions import control_recording
from app.study.sessions.stimulation import delivered
from app.tables.sessions import Controller, StudySession
from app.tables.visits import Visit


class Guess(NamedTuple):
    """A controller, None where it stays open; the policy that its own log names; and why."""

    controller: Controller | None
    policy_id: int | None
    why: Evidence

    def assign(self, session: StudySession, known: int | None) -> None:
        """Give a session this controller, with the policy of its log, else the one that is known of it."""
        policy_id = self.policy_id or known
        blinding.assign(session, self.controller, policy_id if self.controller in POLICY_CONTROLLERS else None)


def controller(db: Session, session: StudySession) -> Guess:
    """Guess by the controller's own log where it names a session of a signed plan or a policy, else by the amplitudes of all sides."""
    slot = controller_log.slot_of_recording(db, control_recording(session))
    if slot is not None and slot.planned is not None:
        facts = {"visit": slot.visit_number, "position": slot.planned.position}
        if slot.planned.sealed and not session.visit.sealed:
            # in its present visit, everyone would see what its sealed plan hides
            return Guess(None, None, Evidence(Source.RECORDING, Reason.SLOT, facts))
        return Guess(Controller(slot.planned.controller), slot.planned.policy_id, Evidence(Source.RECORDING, Reason.SLOT, facts))
    ran = controller_log.of_recording(db, control_recording(session))
    if ran is not None and ran.policy_id is not None:
        return Guess(ran.controller, ran.policy_id, Evidence(Source.RECORDING, Reason.LOG, {"policy": ran.policy_name}))
    if (survey := control_channel.survey(session)) is not None:
        return Guess(None, None, survey)
    try:
        found, why = guess_controller(delivered(db, session))
    except Invalid as error:
        return Guess(None, None, Evidence(Source.RECORDING, Reason.UNREADABLE, {"detail": error.detail}))
    return Guess(found, None, why)


def policy_by_log(db: Session, session: StudySession) -> None:
    """Name the policy of a session whose controller is stated without one, where its log names it and is of that controller."""
    arm = blinding.stated_arm(session, SYSTEM)
    ran = controller_log.of_recording(db, control_recording(session))
    if ran is not None and ran.policy_id is not None and arm is not None and (arm.controller, arm.policy_id) == (ran.controller, None):
        blinding.assign(session, arm.controller, ran.policy_id)


def differs_from_slot(slot: LoggedSlot | None, stated: StatedSession) -> bool:
    """Decide whether a log is of another session of a plan than its sender states; False where it names none of this participant's."""
    if slot is None or slot.planned is None:
        return False
    planned = slot.planned
    if planned.sealed and (stated.controller is not None or stated.policy_id is not None):
        return True  # whether they agree would reveal what ran
    return (
        (stated.visit is not None and stated.visit.id != planned.visit_id)
        or (stated.controller is not None and stated.controller != planned.controller)
        or (stated.policy_id is not None and stated.policy_id != planned.policy_id)
    )


def visit_of_slot(visits: Sequence[Visit], slot: LoggedSlot | None, stated: Visit | None) -> VisitGuess | None:
    """Find the visit of the planned session that a log names; open where the sender states another one, but while its plan's key is sealed.

    None where it names none.
    """
    planned = slot.planned if slot is not None else None
    own = next((v for v in visits if planned is not None and v.id == planned.visit_id), None)
    if planned is None or own is None:
        return None
    facts = {"visit": own.number, "position": planned.position}
    if stated is not None and stated.id != own.id:
        if planned.sealed:  # at another visit everybody would be shown what its sealed plan hides
            return VisitGuess(own, False, Evidence(Source.RECORDING, Reason.SLOT, facts | {"stated": stated.number}))
        return VisitGuess(stated, True, Evidence(Source.RECORDING, Reason.OTHER_VISIT, facts | {"stated": stated.number}))
    return VisitGuess(own, False, Evidence(Source.RECORDING, Reason.SLOT, facts))
