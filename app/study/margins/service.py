"""Rules of margins: a newer version follows an older one, with a reason. The caller commits."""

from __future__ import annotations

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.study import service as study
from app.study.margins.schemas import MarginsIn
from app.study.models import MarginsVersion, Participant
from ml.qoc import Margins


def margins_of(version: MarginsVersion) -> Margins:
    """The margins of a version, for science."""
    return Margins(version.grasp_share, version.rating_points, version.tremor_points)


def change_margins(db: Session, participant: Participant, change: MarginsIn, reason: str, caller: Caller) -> MarginsVersion:
    """Make a new version of what the change names. No change, no version.

    Raises:
        Invalid: no reason. Forbidden: the caller approves no plans of this participant. Conflict: somebody else was faster.
    """
    study.require(caller, can.APPROVE_PLAN, participant)
    current = participant.current_margins
    values = {name: getattr(current, name) for name in MarginsIn.model_fields} | change.model_dump(exclude_unset=True)
    if all(getattr(current, name) == value for name, value in values.items()):
        return current
    if not reason.strip():
        raise Invalid("New margins need the reason why they are changed.", "Say why in a sentence.")
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
