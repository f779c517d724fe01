"""Rules of doses. The caller commits."""

from __future__ import annotations

from datetime import UTC, datetime, time, timedelta

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Invalid
from app.study import access
from app.study.doses.drugs import DRUGS
from app.study.doses.schemas import DoseIn
from app.study.visits.service import require_unlocked
from app.tables.visits import Dose, Visit

_BEFORE, _AFTER = timedelta(days=3), timedelta(hours=36)
"""A dose lies between three days before the visit's day and that day's end in the westernmost time zone, in UTC."""
_AHEAD = timedelta(minutes=10)
"""By how much the clock of whoever enters a dose may be ahead."""


def add_dose(db: Session, visit: Visit, draft: DoseIn, caller: Caller) -> Dose:
    """Write down a dose that was taken.

    Raises:
        Forbidden: the caller enters no data. Conflict: the visit is locked, the participant has withdrawn, or the dose is there already;
            what else was done in the transaction stays.
        Invalid: a time that is not near the visit's day, or has not come yet.
    """
    access.require(caller, can.WRITE_STUDY, visit.participant)
    access.refuse_withdrawn(visit.participant)
    require_unlocked(visit)
    _check_time(visit, draft.taken_at)
    row = Dose(visit_id=visit.id, entered_by=caller.label, **draft.model_dump())
    try:
        with db.begin_nested():
            db.add(row)
    except IntegrityError as error:
        raise Conflict(
            f"{DRUGS[draft.drug].name} at {draft.taken_at:%Y-%m-%d %H:%M} UTC is written down at this visit already.",
            "Two tablets at one time are one dose: remove the one that is there, and enter both together.",
            field="taken_at",
        ) from error
    db.refresh(visit, ["doses"])
    return row


def remove_dose(db: Session, dose: Dose, visit: Visit, reason: str, caller: Caller) -> None:
    """Take back a dose that was not taken so.

    Raises:
        Forbidden: the caller enters no data. Conflict: the visit is locked. Invalid: no reason.
    """
    access.require(caller, can.WRITE_STUDY, visit.participant)
    require_unlocked(visit)
    if not reason.strip():
        raise Invalid("A reason is missing.", "Say why the dose is taken back; the audit trail keeps it.", field="reason")
    set_reason(db, reason.strip())
    dose.removed_at = now()
    db.flush()
    db.refresh(visit, ["doses"])


def _check_time(visit: Visit, taken_at: datetime) -> None:
    if taken_at > now() + _AHEAD:
        words = f"{taken_at:%Y-%m-%d %H:%M} UTC has not come yet."
        raise Invalid(words, "Doses are written down when they were taken. Times are UTC.", field="taken_at")
    if visit.date is None:
        return
    day = datetime.combine(visit.date, time(), UTC)
    if not day - _BEFORE <= taken_at <= day + _AFTER:
        raise Invalid(
            f"{taken_at:%Y-%m-%d %H:%M} UTC is not near visit {visit.number} of {visit.date}.",
            "Give a time on its day or in the three days before, in UTC.",
            field="taken_at",
        )
