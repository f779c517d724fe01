"""The one gate through which pages, exports and analyses learn which controller a session had.

Blinding hangs on this place: who may not know an arm yet gets a masked one from here, and nowhere else is the column read.
"""

from __future__ import annotations

from dataclasses import dataclass

from app.accounts.permissions import Caller
from app.platform.errors import Conflict
from app.study.models import Controller, StudySession

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
    """The arm of a session for this user. Studies are open-label so far, so that whoever may read the session may know its arm.

    Raises:
        Conflict: the session is a proposal, and nobody has stated its controller yet.
    """
    stated = stated_arm(session, user)
    if stated is None:
        raise Conflict(f"Session {session.id} is a proposal without a controller.", "State its controller and confirm it first.")
    return stated


def stated_arm(session: StudySession, user: Caller) -> Arm | None:
    """The arm of a session that may still be a proposal; None where its controller is open."""
    user.require("read", session.visit.participant.site.study_id, session.visit.participant.site_id)
    return None if session._controller is None else Arm(Controller(session._controller), session._policy_id)


def assign(session: StudySession, controller: Controller | None, policy_id: int | None) -> None:
    """Set the arm of a session; without a controller only of a proposal."""
    session._controller = controller
    session._policy_id = policy_id
