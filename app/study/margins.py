"""Margins of a participant: by how much an outcome may be worse than under cDBS; and the levels of verdicts. Versioned."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Final

from pydantic import ConfigDict, Field, ValidationInfo, field_validator
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts import sign_on
from app.accounts.permissions import Caller
from app.platform.audit import signatures
from app.platform.audit.signatures import SignatureOut, SignatureState, Signing, state_of
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.platform.web.schemas import Int, Model, Number, Text
from app.study import access
from app.study.outcome_fields import StatedMargins
from app.study.settings_types import Bound, published
from app.tables.audit import Signature
from app.tables.participants import MarginsLock, MarginsVersion, Participant
from ml.outcomes import OUTCOMES
from ml.qoc import Margins

# API types of margins and levels.

BOUNDS = {
    **{o.margin.field: Bound(o.margin.least, o.margin.most, o.margin.unit) for o in OUTCOMES},
    "test_within": Bound(0.5, 0.99),
    "test_saves": Bound(0.5, 0.99),
    "unsafe_beyond": Bound(0.05, 0.9),
    "nearly_off_share": Bound(0, 0.9, "of the steps"),
}
"""What may be stated. A level of *unsafe* above 0.9 would let a policy pass that is nearly surely worse."""


class MarginsFields(StatedMargins):
    """By how much an outcome may be worse than under cDBS, and how sure a proposal must be of it."""

    test_within: Number = Field(0.8, description="Probability of keeping all outcomes within the margins from which a test is proposed.")
    test_saves: Number = Field(0.9, description="Probability of using less energy than cDBS from which a test is proposed.")
    unsafe_beyond: Number = Field(0.9, description="Probability of an outcome beyond twice its margin from which a policy is unsafe.")
    nearly_off_share: Number = Field(0.2, description="Share of steps below 0.2 of the cDBS amplitude above which a policy is unsafe.")


class MarginsIn(MarginsFields):
    """Margins and levels; what is left out keeps its present value."""

    model_config = ConfigDict(json_schema_extra=published(BOUNDS))

    @field_validator(*BOUNDS)
    @classmethod
    def _within_bounds(cls, value: float, info: ValidationInfo) -> float:
        return BOUNDS[str(info.field_name)].check(value)


class MarginsOut(MarginsFields):
    """A version of a participant's margins and levels."""

    version: int
    created_at: datetime
    created_by: str
    reason: str | None = Field(description="Null for the defaults of an enrolment.")


class MarginsChange(Model):
    """New margins or levels, and why."""

    margins: MarginsIn
    reason: Text = Field(max_length=1000)


class MarginsLockFields(Model):
    """Which margins to lock, and why."""

    version: Int = Field(ge=1, le=100_000, description="Of the present margins, as the caller has read them.")
    reason: Text = Field(max_length=1000, description="What the margins rest on; kept with the lock and in the audit trail.")


class MarginsLockIn(MarginsLockFields, Signing):
    """Which margins to lock, why, and who signs."""


class MarginsLockOut(Model):
    """Margins that were locked."""

    version: int
    reason: str
    created_at: datetime
    created_by: str
    signature: SignatureOut | None
    signature_state: SignatureState = Field(description="`broken`: a value was changed since. `not_kept`: locked by an earlier version.")


# What a clinician signs when margins are locked, and whether the signatures still stand. The caller commits.

KIND: Final = "margins_lock"
MEANING: Final = "margins fixed before the sessions that they judge"


def sign_lock(db: Session, participant: Participant, lock: MarginsLock, caller: Caller, password: str, code: str) -> Signature:
    """Sign a lock over the values of its margins and levels. Raises as `app.accounts.sign_on.sign`."""
    content = signed_content(participant, lock)
    return sign_on.sign(db, caller, password, kind=KIND, subject_id=lock.id, meaning=MEANING, content=content, code=code)


def signatures_of_locks(db: Session, participant: Participant) -> dict[int, tuple[SignatureState, Signature | None]]:
    """For each lock of a participant's margins, by its number: whether its signature stands, and the signature.

    Earlier locks are held against their values too: visits that began under them keep their verdict.
    """
    locks = participant.margins_locks
    found = signatures.newest_of_each(db, KIND, [lock.id for lock in locks])
    return {lock.id: (state_of(found.get(lock.id), signed_content(participant, lock)), found.get(lock.id)) for lock in locks}


def signed_content(participant: Participant, lock: MarginsLock) -> dict[str, Any]:
    """All that a signature under a lock covers: whose margins, each value and level, who stated and who locked them, and why."""
    version = lock.margins
    return {
        "participant": participant.code,
        "version": version.version,
        "stated_by": version.created_by,
        "locked_by": lock.created_by,
        "lock_reason": lock.reason,
        **{name: getattr(version, name) for name in MarginsFields.model_fields},
    }


# Rules of margins: a newer version follows an older one, with a reason. The caller commits.


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
    sign_lock(db, participant, row, caller, password, code)
    return row


# Rows of margins as API types.


def lock_rows(db: Session, participant: Participant) -> list[MarginsLockOut]:
    """The locks of a participant's margins, oldest first, each with the version that it locked and what became of its signature."""
    found = signatures_of_locks(db, participant)
    return [
        MarginsLockOut(
            version=lock.margins.version,
            reason=lock.reason,
            created_at=lock.created_at,
            created_by=lock.created_by,
            signature=SignatureOut.model_validate(found[lock.id][1]) if found[lock.id][1] else None,
            signature_state=found[lock.id][0],
        )
        for lock in participant.margins_locks
    ]
