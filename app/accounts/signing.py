"""Signing: the signer shows again who they are, and the signed content is stored (`app.platform.signatures`).

They give the password again (with the code of a second factor), or the hospital's sign-on asked them again. That was at most five minutes
ago, in this browser session, for this one signature.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.accounts.service import confirm_password
from app.accounts.sign_on.service import use_confirmation
from app.platform.errors import Forbidden, about
from app.platform.signatures.service import Signer, record
from app.tables.audit import Signature


def sign(
    db: Session, caller: Caller, password: str, *, kind: str, subject_id: int, meaning: str, content: Mapping[str, Any], code: str = ""
) -> Signature:
    """Sign something with one's password or, where it is empty, a fresh sign-on. The transaction is not committed.

    The function that calls this must check whether the caller may sign it at all.

    Args:
        kind: what is signed, e.g. `plan`. subject_id: which. meaning: what the signature says, e.g. "approved for use in this participant".
        content: all that is signed; kept with its hash. code: of the second factor, where the signer has one.

    Raises:
        Forbidden: the system, which is no person, a wrong password or code, or a confirmation that is too old. TooMany: too many wrong
            passwords lately.
    """
    if caller.user_id is None:
        raise Forbidden("Only a person can sign.", "Sign in as the person who signs.")
    if password or caller.confirmed_at is None:
        with about("password"):
            confirm_password(caller.user_id, password, code)
    else:
        use_confirmation(db, caller)
    return record(db, Signer(caller.user_id, caller.label), kind=kind, subject_id=subject_id, meaning=meaning, content=content)
