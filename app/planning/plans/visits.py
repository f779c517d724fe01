"""Visit of a plan, and removal of a visit that did not take place. The caller commits."""

from __future__ import annotations

from datetime import date, timedelta

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.planning.plans import repository
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Invalid
from app.study import access, visits
from app.study.schemas import VisitIn
from app.study.visits import require_unlocked
from app.tables.participants import Participant
from app.tables.visits import Visit

_LAST_ZONE = timedelta(hours=-12)
"""Offset from UTC of the place where a day ends last."""


def today() -> date:
    """Return the day by which a visit is past: one that has not ended everywhere is not. In the afternoon of a clinic in California it is
    tomorrow in UTC. On which day a bundle runs is decided by the tablet's own date.
    """
    return (now() + _LAST_ZONE).date()


def visit_for_draft(
    db: Session, participant: Participant, visit_id: int | None, number: int | None, day: date | None, caller: Caller
) -> Visit:
    """Return the visit that a draft is for: an open one by its id, or a new one, which has a number and a date.

    Raises:
        Invalid: neither is named, a new visit without a date, or a visit that is not open: another participant's, past, or with sessions.
        Conflict: the number is taken.
    """
    if visit_id is not None:
        for visit in repository.open_visits(db, participant.id, today()):
            if visit.id == visit_id:
                return visit
        raise Invalid(
            f"Visit {visit_id} cannot be planned from here: it has sessions, is in the past, or is another participant's.",
            "Choose another.",
        )
    if number is None:
        raise Invalid("No visit is chosen.", "Choose an open visit, or name the number and the date of a new one.")
    if day is None:
        raise Invalid(f"The new visit {number} has no date.", "Give the day on which the participant comes.", field="visit_date")
    return visits.add_visit(db, participant, VisitIn(number=number, date=day), caller)


def remove_visit(db: Session, visit: Visit, reason: str, caller: Caller) -> None:
    """Remove a visit in which nothing was done, with its drafts; the audit trail keeps what it was, and why it went.

    Raises:
        Conflict: it is locked, has sessions (proposed ones too), doses, adverse events or data queries, or a plan of it was once signed.
        Invalid: no reason.
    """
    access.require(caller, can.WRITE_STUDY, visit.participant)
    if not reason.strip():
        raise Invalid("A reason is missing.", "Say why the visit is removed; it is written to the audit trail.")
    repository.lock_visit(db, visit.id)
    require_unlocked(visit)
    held = repository.what_holds(db, visit.id)
    if held:
        raise Conflict(
            f"Visit {visit.number} is not empty: it has {', '.join(held)}.", "Only a visit in which nothing was done is removed."
        )
    set_reason(db, reason.strip())
    repository.delete_visit(db, visit)
    db.flush()
    set_reason(db, None)
