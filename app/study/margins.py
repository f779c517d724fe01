"""Margins of a participant: by how much an outcome may be worse than under cDBS; levels of verdicts; and what is confirmed by them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from datetime import datetime
from typing import Any, Final

from pydantic import ConfigDict, Field, ValidationInfo, field_validator
from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts import sign_on
from app.accounts.permissions import Caller
from app.platform.audit import signatures
from app.platform.audit.signatures import SignatureOut, SignatureState, Signing, state_of
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid, NotFound
from app.platform.web.schemas import Int, Model, Number, Text
from app.study import access
from app.study.outcome_fields import StatedMargins
from app.study.settings_types import Bound, published
from app.tables.audit import Signature
from app.tables.learning import Policy
from app.tables.participants import DeclaredConfirmation, MarginsLock, MarginsVersion, Participant
from ml.outcomes import JUDGED, OUTCOMES
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
    """Margins and levels; omitted ones keep their present value."""

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
    """Margins to lock, and the reason."""

    version: Int = Field(ge=1, le=100_000, description="Of the present margins, as the caller has read them.")
    reason: Text = Field(max_length=1000, description="What the margins rest on; kept with the lock and in the audit trail.")


class MarginsLockIn(MarginsLockFields, Signing):
    """Margins to lock, the reason, and the signature."""


class MarginsLockOut(Model):
    """Margins that were locked."""

    version: int
    reason: str
    created_at: datetime
    created_by: str
    signature: SignatureOut | None
    signature_state: SignatureState = Field(description="`broken`: a value was changed since. `not_kept`: locked by an earlier version.")


# What a clinician signs when margins are locked, and whether the signatures are still valid. The caller commits.

KIND: Final = "margins_lock"
MEANING: Final = "margins fixed before the sessions that they judge"


def sign_lock(db: Session, participant: Participant, lock: MarginsLock, caller: Caller, password: str, code: str) -> Signature:
    """Sign a lock over the values of its margins and levels. Raises as `app.accounts.sign_on.sign`."""
    content = signed_content(participant, lock)
    return sign_on.sign(db, caller, password, kind=KIND, subject_id=lock.id, meaning=MEANING, content=content, code=code)


def signatures_of_locks(db: Session, participant: Participant) -> dict[int, tuple[SignatureState, Signature | None]]:
    """Return, for each lock of a participant's margins by its number, the state of its signature, and the signature.

    Earlier locks are checked against their values too: visits that began under them keep their verdict.
    """
    locks = participant.margins_locks
    found = signatures.newest_of_each(db, KIND, [lock.id for lock in locks])
    return {lock.id: (state_of(found.get(lock.id), signed_content(participant, lock)), found.get(lock.id)) for lock in locks}


def signed_content(participant: Participant, lock: MarginsLock) -> dict[str, Any]:
    """Build the signed content of a lock: each value and level, the outcomes judged, who stated and locked them, and why."""
    version = lock.margins
    return {
        "participant": participant.code,
        "version": version.version,
        "stated_by": version.created_by,
        "locked_by": lock.created_by,
        "lock_reason": lock.reason,
        "judged": [o.key for o in JUDGED],
        **{name: getattr(version, name) for name in MarginsFields.model_fields},
    }


# Rules of margins: a newer version follows an older one, with a reason. The caller commits.


def margins_of(version: MarginsVersion) -> Margins:
    """Convert a version to margins for the analyses."""
    return Margins(**{o.margin.field: getattr(version, o.margin.field) for o in OUTCOMES})


def change_margins(db: Session, participant: Participant, change: MarginsIn, reason: str, caller: Caller) -> MarginsVersion:
    """Make a new version of what the change names. No change, no version.

    Raises:
        Invalid: no reason. Forbidden: the caller approves no plans of this participant. Conflict: another person was faster.
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
        raise Conflict("Another person changed these margins at the same time.", "Load them again and repeat your change.") from error
    return row


def lock_margins(
    db: Session, participant: Participant, version: int, reason: str, caller: Caller, password: str, code: str = ""
) -> MarginsLock:
    """Lock the present margins, signed over their values: sessions recorded from now on are judged by them, earlier ones only explore.

    Args:
        version: of the margins that the caller looked at. password: of the caller, asked for again; empty where a fresh sign-on replaces
            it. code: of the second factor.

    Raises:
        Invalid: no reason. Forbidden: the caller approves no plans of this participant. Forbidden, TooMany: as `app.accounts.sign_on`.
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
    """List the locks of a participant's margins, oldest first, each with the version that it locked and the state of its signature."""
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


# Declared confirmations: signed once, all later sessions of a policy are judged by the margins of then, whatever is planned.

CONFIRMATION: Final = "declared_confirmation"
CONFIRMED: Final = "confirmation declared before the sessions that it counts"


class ConfirmationFields(Model):
    """Policy whose later sessions are to confirm, and why it was chosen."""

    policy_id: Int = Field(ge=1)
    reason: Text = Field(max_length=1000, description="Why this policy; kept with the declaration and in the audit trail.")


class ConfirmationIn(ConfirmationFields, Signing):
    """Confirmation to declare, and who signs."""


class ConfirmationOut(Model):
    """A declared confirmation."""

    policy_id: int
    policy: str
    margins_version: int
    reason: str
    created_at: datetime
    created_by: str
    signature: SignatureOut | None
    signature_state: SignatureState = Field(description="`broken`: a value was changed since.")


def declarations(db: Session, participant_ids: Collection[int]) -> dict[int, list[DeclaredConfirmation]]:
    """Return the declared confirmations of participants, oldest first, by participant."""
    found: dict[int, list[DeclaredConfirmation]] = {i: [] for i in participant_ids}
    query = select(DeclaredConfirmation).where(DeclaredConfirmation.participant_id.in_(found)).order_by(DeclaredConfirmation.id)
    for row in db.scalars(query):
        found[row.participant_id].append(row)
    return found


def policies_of(db: Session, participant: Participant) -> Sequence[Policy]:
    """Return the participant's policies that can still be declared: learned or made elsewhere, not retired, not declared before."""
    declared = select(DeclaredConfirmation.policy_id).where(DeclaredConfirmation.participant_id == participant.id)
    open_ = select(Policy).where(Policy.participant_id == participant.id, Policy.kind != "baseline", Policy.retired_reason.is_(None))
    return db.scalars(open_.where(Policy.id.not_in(declared)).order_by(Policy.name)).all()


def declare(
    db: Session, participant: Participant, choice: ConfirmationFields, caller: Caller, password: str, code: str = ""
) -> DeclaredConfirmation:
    """Sign that all later sessions of a policy confirm, by the margins that are locked now. The caller commits.

    Args:
        password: of the caller, asked for again; empty where a fresh sign-on replaces it. code: of the second factor.

    Raises:
        Forbidden: the caller sets no margins of this participant, or as `app.accounts.sign_on`, as TooMany is. Invalid: no reason.
        Conflict: no margins are locked, a newer version waits for its lock, the policy is retired, or was declared before.
        NotFound: the participant has no such policy.
    """
    access.require(caller, can.SET_MARGINS, participant)
    lock, policy = participant.margins_lock, db.get(Policy, choice.policy_id)
    if policy is None or policy.participant_id != participant.id:
        raise NotFound(f"Participant {participant.code} has no policy {choice.policy_id}.", "Choose one of its policies.")
    if lock is None or lock.margins_version_id != participant.current_margins.id:
        raise Conflict("The present margins are not locked.", "Lock them first: a confirmation is judged by them for good.")
    if policy.retired_reason:
        raise Conflict(f"Policy '{policy.name}' was retired: {policy.retired_reason}.", "Choose another policy.")
    if not choice.reason.strip():
        raise Invalid("A declaration needs a reason.", "Say in a sentence why this policy is to be confirmed.", field="reason")
    row = DeclaredConfirmation(
        participant_id=participant.id,
        policy_id=policy.id,
        margins_lock_id=lock.id,
        reason=choice.reason.strip(),
        created_by=caller.label,
    )
    row.lock = lock
    set_reason(db, row.reason)
    db.add(row)
    try:
        db.flush()
    except IntegrityError as error:
        db.rollback()
        raise Conflict(f"The confirmation of policy '{policy.name}' was declared before.", "One declaration counts for good.") from error
    content = declared_content(participant, row, policy)
    sign_on.sign(db, caller, password, kind=CONFIRMATION, subject_id=row.id, meaning=CONFIRMED, content=content, code=code)
    return row


def declared_content(participant: Participant, row: DeclaredConfirmation, policy: Policy) -> dict[str, Any]:
    """Return all that a signature under a declaration covers: whose policy, its bytes, the lock of the margins, and why."""
    return {
        "participant": participant.code,
        "policy": policy.id,
        "policy_name": policy.name,
        "onnx_sha256": policy.onnx_sha256,
        "margins_version": row.lock.margins.version,
        "margins_lock": row.margins_lock_id,
        "declared_by": row.created_by,
        "reason": row.reason,
    }


def confirmation_rows(db: Session, participant: Participant) -> list[ConfirmationOut]:
    """Return the declared confirmations of a participant as API types, oldest first, each with what became of its signature."""
    rows = declarations(db, [participant.id])[participant.id]
    found = signatures.newest_of_each(db, CONFIRMATION, [row.id for row in rows])
    result = []
    for row in rows:
        policy, signature = db.get_one(Policy, row.policy_id), found.get(row.id)
        result.append(
            ConfirmationOut(
                policy_id=policy.id,
                policy=policy.name,
                margins_version=row.lock.margins.version,
                reason=row.reason,
                created_at=row.created_at,
                created_by=row.created_by,
                signature=SignatureOut.model_validate(signature) if signature else None,
                signature_state=state_of(signature, declared_content(participant, row, policy)),
            )
        )
    return result
