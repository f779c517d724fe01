"""Rows of margins as API types."""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.platform.signatures.schemas import SignatureOut
from app.study.margins.schemas import MarginsLockOut
from app.study.margins.sign_off import signatures_of_locks
from app.tables.participants import Participant


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
