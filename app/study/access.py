"""Permissions of a caller for a participant, a site and a study, while they take part."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.errors import Conflict, NotFound
from app.study import repository
from app.tables.accounts import Site
from app.tables.participants import Participant

WITHDRAWN = "withdrawn"


NOT_AFTER_WITHDRAWAL = frozenset(
    {can.UPLOAD, can.RUN_JOBS, can.WRITE_POLICIES, can.DRAFT_PLAN, can.TAKE_BUNDLES, can.WRITE_SETTINGS}
    | {can.SIGN_PLAN, can.RELEASE, can.DECIDE_GATE, can.CLEAR_EVENT, can.SET_MARGINS}
)
"""What needs a participant who takes part. Records that exist may still be corrected, and a key be opened in an emergency."""


def withdrawn_codes(participants: Iterable[Participant]) -> frozenset[str]:
    """Return the codes of withdrawn participants, for lists that mark them."""
    return frozenset(p.code for p in participants if p.status == WITHDRAWN)


def require(caller: Caller, permission: str, participant: Participant) -> None:
    """Raise NotFound or Forbidden unless the caller holds the permission for this participant.

    Raises Conflict where it would be new work for a participant who has withdrawn.
    """
    caller.require(permission, participant.site.study_id, participant.site_id)
    if caller.is_system and permission not in can.AFTER_END:
        refuse_ended_study(participant.site)
    if permission in NOT_AFTER_WITHDRAWAL:
        refuse_withdrawn(participant)


def refuse_withdrawn(participant: Participant) -> None:
    """Raise Conflict for new work for a participant who has withdrawn."""
    if participant.status == WITHDRAWN:
        raise Conflict(
            f"Participant {participant.code} has withdrawn from the study: nothing new is recorded, computed or planned.",
            "What is there can be read and exported. A mistake is taken back on the participant's page.",
        )


def require_still_taking_part(db: Session, participant: Participant) -> None:
    """Raise Conflict where the participant has withdrawn, or the study has ended, since the caller was judged.

    Neither happens from here to the end of the transaction: a withdrawal or an end waits for it, and sees what it made.
    """
    repository.hold_participation(db, participant)
    refuse_ended_study(participant.site)
    refuse_withdrawn(participant)


def refuse_ended(site: Site) -> None:
    """Raise Conflict for new participants and new data of a site or a study that has ended."""
    if site.ended_at is not None:
        raise Conflict(
            f"Site '{site.code}' has ended: it takes no new participants and no uploads.",
            "An administrator of the study can open it again.",
        )
    refuse_ended_study(site)


def refuse_ended_study(site: Site) -> None:
    """Raise Conflict for any change in a study that has ended: to people it is refused with their roles (`Grant.holds`)."""
    if site.study.ended_at is not None:
        raise Conflict(f"Study '{site.study.code}' has ended: it is read and exported, and nothing in it changes.", can.STUDY_ENDED_HINT)


def may(caller: Caller, permission: str, participant: Participant) -> bool:
    """Check whether the caller holds the permission for this participant: for pages that hide what would be refused."""
    return caller.may(permission, participant.site.study_id, participant.site_id)


class Owned(Protocol):
    """A row of one participant."""

    @property
    def participant_id(self) -> int | None:
        """Participant that owns the row."""


def require_own(participant: Participant, row: Owned, name: str) -> None:
    """Require that objects named together belong to one participant.

    Args:
        participant: whose object it should be. row: the object. name: what to call it, e.g. "policy 7".

    Raises:
        NotFound: it is another participant's.
    """
    if row.participant_id != participant.id:
        raise NotFound(f"Participant {participant.code} has no {name}.", "Choose one from the participant's own list.")
