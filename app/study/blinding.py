"""The one gate through which pages, exports and analyses learn which controller a session had.

Blinding depends on this module: nowhere else is the column read. A user who may not know an arm is refused here, or sees that it is hidden.
The gate checks two things. One is a person's role (blinded assessor). The other is a visit under a blinded plan whose key is sealed: only
letters are known of it (`app.planning.plans.sign_off`).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.errors import Conflict, Forbidden
from app.study import repository
from app.tables.participants import Participant
from app.tables.sessions import Controller, StudySession
from app.tables.visits import Visit

CONTROLLER_NAMES: dict[Controller, str] = {
    Controller.CDBS: "cDBS",
    Controller.RL: "RL",
    Controller.DISTILLED: "Distilled RL",
    Controller.NO_DBS: "No DBS",
    Controller.RANDOM: "Random",
    Controller.OTHER: "Other",
}


@dataclass(frozen=True)
class Arm:
    """Arm that drove a session, as far as the caller may know."""

    controller: Controller
    policy_id: int | None

    @property
    def label(self) -> str:
        """The controller's name for a page."""
        return CONTROLLER_NAMES[self.controller]


def arm(session: StudySession, user: Caller) -> Arm:
    """Return the arm of a session for this user.

    Raises:
        Conflict: the session is a proposal without a stated controller.
        Forbidden: the user may not know it (`may_know`).
    """
    stated = stated_arm(session, user)
    if stated is None:
        raise Conflict(f"Session {session.id} is a proposal without a controller.", "State its controller and confirm it first.")
    return stated


def stated_arm(session: StudySession, user: Caller) -> Arm | None:
    """Return the arm of a session that may still be a proposal; None where its controller is open. Raises Forbidden as `arm`."""
    require_known(session.visit, user)
    return None if session._controller is None else Arm(Controller(session._controller), session._policy_id)


def is_stated(session: StudySession) -> bool:
    """Check whether a controller is stated for a session, whichever it is."""
    return session._controller is not None


def visible_arm(session: StudySession, user: Caller) -> Arm | None:
    """Return the arm for a list, or None where it is hidden from this user or open."""
    return stated_arm(session, user) if may_know(session.visit, user) else None


def visible_arms(sessions: Sequence[StudySession], user: Caller) -> list[Arm | None]:
    """Return the arms of many sessions for a list, checking each of their visits once."""
    known = {i: may_know(visit, user) for i, visit in {s.visit_id: s.visit for s in sessions}.items()}
    return [Arm(Controller(s._controller), s._policy_id) if known[s.visit_id] and s._controller is not None else None for s in sessions]


def may_know(visit: Visit, user: Caller) -> bool:
    """Check whether the user may know the arms of a visit.

    While the key of its blinded plan is sealed no person may, not even its author or signer. Machines may, and show what they read to no
    person. Otherwise everybody may; a blinded assessor may once the visit is locked.
    """
    site = visit.participant.site
    user.require(can.READ, site.study_id, site.id)
    if user.is_system:
        return True
    return not visit.sealed and (user.may(can.READ_ARMS, site.study_id, site.id) or visit.locked)


def require_known(visit: Visit, user: Caller) -> None:
    """Raise Forbidden where the user may not know the arms of a visit, nor see what gives them away."""
    if may_know(visit, user):
        return
    if visit.sealed:
        raise Forbidden(
            f"What ran at visit {visit.number} is hidden from everybody while the key of its blinded plan is sealed.",
            "A clinician opens the key on the page of the plan.",
        )
    raise Forbidden(
        f"What ran at visit {visit.number} is hidden from you until the visit is locked.",
        "You are a blinded assessor; a clinician locks the visit when its data are complete.",
    )


def unsealed(sessions: Iterable[StudySession]) -> list[StudySession]:
    """Select sessions whose visit's key is not sealed: comparisons by controller exclude the others, for every caller, jobs too."""
    return [s for s in sessions if not s.visit.sealed]


def sights(db: Session, participants: Sequence[Participant], user: Caller) -> list[Hashable]:
    """Return what the user may know of each participant's arms: equal sights, equal arms. The visits that are hidden from the user."""
    for p in participants:
        user.require(can.READ, p.site.study_id, p.site.id)
    hidden = repository.hidden_visits(db, [p.id for p in participants])
    told = [user.is_system or user.may(can.READ_ARMS, p.site.study_id, p.site.id) for p in participants]
    return [(hidden.sealed(p.id), None if knows else hidden.unlocked(p.id)) for p, knows in zip(participants, told, strict=True)]


def assign(session: StudySession, controller: Controller | None, policy_id: int | None) -> None:
    """Set the arm of a session; without a controller only of a proposal."""
    session._controller = controller
    session._policy_id = policy_id
