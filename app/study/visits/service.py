"""Lock and unlock a visit: closed for changes, open to blinded assessors. The caller commits."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.study import repository
from app.study.blinding import Arm, visible_arms
from app.study.visits import sign_off
from app.tables.sessions import StudySession
from app.tables.visits import Visit, VisitLock

Day = tuple[Visit, list[tuple[StudySession, Arm | None]]]


def days_of(visits: Sequence[Visit], sessions: Sequence[StudySession], caller: Caller) -> list[Day]:
    """Visits with their sessions in order, each with its arm as far as the caller may know it."""
    found: dict[int, list[tuple[StudySession, Arm | None]]] = {v.id: [] for v in visits}
    for session, arm in zip(sessions, visible_arms(sessions, caller), strict=True):
        found.get(session.visit_id, []).append((session, arm))
    return [(v, found[v.id]) for v in visits]


def lock(db: Session, visit: Visit, reason: str, caller: Caller, password: str, code: str = "") -> VisitLock:
    """Close the data of a visit, signed over what they are.

    Args:
        password: of the caller, asked for again; empty where a fresh sign-on stands for it. code: of the second factor.

    Raises:
        Conflict: it is locked already, or sessions wait for confirmation. Invalid: no reason. Forbidden, TooMany: as
            `app.accounts.sign_on`.
    """
    waiting = [s for s in repository.proposals_of_participant(db, visit.participant_id) if s.visit_id == visit.id]
    if waiting:
        raise Conflict(
            f"Visit {visit.number} has {len(waiting)} proposed session(s) that nobody has confirmed.", "Confirm or discard them, then lock."
        )
    row = _set(db, visit, True, reason, caller)
    sign_off.sign_lock(db, visit, row, caller, password, code)
    return row


def unlock(db: Session, visit: Visit, reason: str, caller: Caller) -> VisitLock:
    """Open the data of a visit again. Raises Conflict where it is not locked, Invalid without a reason."""
    return _set(db, visit, False, reason, caller)


def require_unlocked(visit: Visit) -> None:
    """Raises Conflict where a visit is locked."""
    if visit.locked:
        last = visit.locks[-1]
        raise Conflict(
            f"Visit {visit.number} was locked by {last.created_by} on {last.created_at:%Y-%m-%d %H:%M} UTC; nothing was changed.",
            "A clinician unlocks it first, with a reason.",
        )


def _set(db: Session, visit: Visit, locked: bool, reason: str, caller: Caller) -> VisitLock:
    site = visit.participant.site
    caller.require(can.LOCK_VISIT, site.study_id, site.id)
    if not reason.strip():
        raise Invalid("A reason is missing.", "Say why; it is kept with the lock.")
    repository.lock_row(db, visit)
    if visit.locked is locked:
        raise Conflict(f"Visit {visit.number} is {'locked already' if locked else 'not locked'}.", "Load the page again.")
    set_reason(db, reason.strip())
    held = visit.participant.current_settings.id if locked else None
    row = VisitLock(visit_id=visit.id, locked=locked, reason=reason.strip(), created_by=caller.label, settings_version_id=held)
    visit.locks.append(row)
    db.flush()
    return row
