"""What a clinician signs when margins are locked, and whether the signatures still stand. The caller commits."""

from __future__ import annotations

from typing import Any, Final

from sqlalchemy.orm import Session

from app.accounts import sign_on
from app.accounts.permissions import Caller
from app.platform.signatures import repository as signatures
from app.platform.signatures.service import SignatureState, state_of
from app.study.margins.schemas import MarginsFields
from app.tables.audit import Signature
from app.tables.participants import MarginsLock, Participant

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
