"""Rules of margins: a newer version follows an older one, with a reason. The caller commits."""

from __future__ import annotations

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.study import access
from app.study.margins import sign_off
from app.study.margins.schemas import MarginsIn
from app.tables.participants import MarginsLock, MarginsVersion, Participant
from ml.outcomes import OUTCOMES
from ml.qoc import Margins


def margins_of(version: MarginsVersion) -> Margins:
    """The margins of a version, for science."""
    return Margins(**{o.margin.field: getattr(version, o.margin.field) for o in OUTCOMES})


def change_margins(db: Session, participant: Participant, change: MarginsIn, reason: str, caller: Caller) -> MarginsVersion:
    """Make a new version of what the change names. No change, no version.

    Raises:
        Invalid: no reason. Forbidden: the caller approves no plans of this participant. Conflict: somebody else was faster.
    """
    access.require(caller, can.SET_MARGINS, participant)
    current = participant.current_margins
    values = {name: getattr(current, name) for name in MarginsIn.model_fields} | change.model_dump(exclude_unset=True)
    if all(getattr(current, name) == value for name, value in values.items()):
        return current
    if not reason.strip():
        raise Invalid("New margins need the reason why they are changed.", "Say why in a sentence.", field="reason")
    row = MarginsVersion(
        participant_id=participant.id, version=current.version + 1, created_by=caller.label, reason=reason.strip(), **values
    )
    set_reason(db, row.reason)
    participant.margins.append(row)
    try:
        db.flush()
    except IntegrityError as error:
        db.rollback()
        raise Conflict("Somebody else changed these margins at the same time.", "Load them again and repeat your change.") from error
    return row


def lock_margins(
    db: Session, participant: Participant, version: int, reason: str, caller: Caller, password: str, code: str = ""
) -> MarginsLock:
    """Fix the present margins, signed over their values: sessions recorded from now on are judged by them, earlier ones only explore.

    Args:
        version: of the margins that the caller looked at. password: of the caller, asked for again; empty where a fresh sign-on stands
            for it. code: of the second factor.

    Raises:
        Invalid: no reason. Forbidden: the caller approves no plans of this participant, or as `app.accounts.sign_on`, as TooMany is.
            Conflict: newer margins are there, or these are locked already.
    """
    access.require(caller, can.SET_MARGINS, participant)
    current = participant.current_margins
    if current.version != version:
        raise Conflict(f"The present margins are version {current.version}, not {version}.", "Look at them and lock again.")
    if participant.margins_lock and participant.margins_lock.margins_version_id == current.id:
        raise Conflict(f"Version {version} is locked already.", "A new lock would only take away evidence.")
    if not reason.strip():
        raise Invalid("A lock needs a reason.", "Say what the margins rest on, in a sentence.", field="reason")
    row = MarginsLock(participant_id=participant.id, margins_version_id=current.id, reason=reason.strip(), created_by=caller.label)
    set_reason(db, row.reason)
    participant.margins_locks.append(row)
    db.flush()
    sign_off.sign_lock(db, participant, row, caller, password, code)
    return row
