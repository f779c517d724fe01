"""Signing something: the password is asked for again, and what is signed is kept (`app.platform.signatures`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.accounts.service import confirm_password
from app.platform.errors import Forbidden
from app.platform.signatures.models import Signature
from app.platform.signatures.service import Signer, record


def sign(
    db: Session, caller: Caller, password: str, *, kind: str, subject_id: int, meaning: str, content: Mapping[str, Any], code: str = ""
) -> Signature:
    """Sign something with one's password. Whether the caller may sign it at all is the caller's question; the transaction is not committed.

    Args:
        kind: what is signed, e.g. `plan`. subject_id: which. meaning: what the signature says, e.g. "approved for use in this participant".
        content: all that is signed; kept with its hash. code: of the second factor, where the signer has one.

    Raises:
        Forbidden: the system, which is no person, or a wrong password or code. TooMany: too many wrong passwords lately.
    """
    if caller.user_id is None:
        raise Forbidden("Only a person can sign.", "Sign in as the person who signs.")
    confirm_password(caller.user_id, password, code)
    return record(db, Signer(caller.user_id, caller.label), kind=kind, subject_id=subject_id, meaning=meaning, content=content)
