"""The one gate through which pages, exports and analyses learn which controller a session had.

Blinding hangs on this place: who may not know an arm is refused here or told that it is hidden, and nowhere else is the column read. It
holds for two things: a person's role (blinded assessor), and a visit under a blinded plan whose key is sealed, of which nobody knows more
than letters (`app.planning.plans.sign_off`).
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
    """What drove a session, as far as the asker may know."""

    controller: Controller
    policy_id: int | None

    @property
    def label(self) -> str:
        """The controller's name for a page."""
        return CONTROLLER_NAMES[self.controller]


def arm(session: StudySession, user: Caller) -> Arm:
    """The arm of a session for this user.

    Raises:
        Conflict: the session is a proposal, and nobody has stated its controller yet.
        Forbidden: the user may not know it (`may_know`).
    """
    stated = stated_arm(session, user)
    if stated is None:
        raise Conflict(f"Session {session.id} is a proposal without a controller.", "State its controller and confirm it first.")
    return stated


def stated_arm(session: StudySession, user: Caller) -> Arm | None:
    """The arm of a session that may still be a proposal; None where its controller is open. Raises Forbidden as `arm`."""
    require_known(session.visit, user)
    return None if session._controller is None else Arm(Controller(session._controller), session._policy_id)


def is_stated(session: StudySession) -> bool:
    """Whether a controller stands with a session, whichever it is."""
    return session._controller is not None


def visible_arm(session: StudySession, user: Caller) -> Arm | None:
    """For lists: the arm, or None where it is hidden from this user or open."""
    return stated_arm(session, user) if may_know(session.visit, user) else None


def visible_arms(sessions: Sequence[StudySession], user: Caller) -> list[Arm | None]:
    """The same of many sessions, asking once for each of their visits."""
    known = {i: may_know(visit, user) for i, visit in {s.visit_id: s.visit for s in sessions}.items()}
    return [Arm(Controller(s._controller), s._policy_id) if known[s.visit_id] and s._controller is not None else None for s in sessions]


def may_know(visit: Visit, user: Caller) -> bool:
    """Whether the user may know the arms of a visit.

    While the key of its blinded plan is sealed no person may, whoever drafted or signed it; machines may, and show nobody what they read.
    Else everybody but a blinded assessor, and these once the visit is locked.
    """
    site = visit.participant.site
    user.require(can.READ, site.study_id, site.id)
    if user.is_system:
        return True
    return not visit.sealed and (user.may(can.READ_ARMS, site.study_id, site.id) or visit.locked)


def require_known(visit: Visit, user: Caller) -> None:
    """Raises Forbidden where the user may not know the arms of a visit, nor see what gives them away."""
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
    """Those whose visit's key is not sealed: what compares sessions by controller leaves the others out, whoever asks, jobs too."""
    return [s for s in sessions if not s.visit.sealed]


def sights(db: Session, participants: Sequence[Participant], user: Caller) -> list[Hashable]:
    """What the user may know of each participant's arms: equal sights, equal arms. The visits that are hidden from the user."""
    for p in participants:
        user.require(can.READ, p.site.study_id, p.site.id)
    hidden = repository.hidden_visits(db, [p.id for p in participants])
    told = [user.is_system or user.may(can.READ_ARMS, p.site.study_id, p.site.id) for p in participants]
    return [(hidden.sealed(p.id), None if knows else hidden.unlocked(p.id)) for p, knows in zip(participants, told, strict=True)]


def assign(session: StudySession, controller: Controller | None, policy_id: int | None) -> None:
    """Set the arm of a session; without a controller only of a proposal."""
    session._controller = controller
    session._policy_id = policy_id
