"""Electronic signatures: who signed what, when, with which meaning. `app.accounts.sign_on.sign` asks for the password and makes one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any

from pydantic import Field
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.platform.web.schemas import Model, Text
from app.tables.audit import Signature

# Every query of signatures.


def signatures_of(db: Session, kind: str, subject_id: int) -> Sequence[Signature]:
    """List every signature under one thing, newest first."""
    mine = (Signature.subject_kind == kind) & (Signature.subject_id == subject_id)
    return db.scalars(select(Signature).where(mine).order_by(Signature.id.desc())).all()


def newest_of_each(db: Session, kind: str, subject_ids: Collection[int]) -> dict[int, Signature]:
    """Find the newest signature under each of several things of a kind; unsigned ones are omitted."""
    if not subject_ids:
        return {}
    mine = (Signature.subject_kind == kind) & Signature.subject_id.in_(subject_ids)
    return {row.subject_id: row for row in db.scalars(select(Signature).where(mine).order_by(Signature.id))}


def contents(db: Session) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Yield number, hash and content of every signature."""
    rows = db.execute(select(Signature.id, Signature.sha256, Signature.content).order_by(Signature.id).execution_options(yield_per=100))
    for row in rows:
        yield row[0], row[1], row[2]


# API types of signatures, of whatever is signed.


class Signing(Model):
    """Credentials of a signer, who proves their identity again."""

    password: Text = Field(max_length=1000, description="The signer's own, asked for again.")
    code: Text = Field("", max_length=40, description="Of the signer's second factor, or a recovery code; empty where there is none.")


class SignatureOut(Model):
    """Signature: its signer, time and meaning."""

    signer: str
    signed_at: datetime
    meaning: str
    sha256: str = Field(description="Of the canonical JSON of all that was signed.")


# Rules of signatures: what is hashed, and whether a signature is still valid. The caller commits.

_EXACT = 2**53
_RECORDED = ("id", "subject_kind", "subject_id", "meaning", "sha256", "signed_by", "signer")


class SignatureState(StrEnum):
    """State of a signature."""

    NONE = "none"  # nothing that wants one: a draft, an unlock, a policy that was not released
    STANDS = "stands"
    BROKEN = "broken"  # something was changed since
    NOT_KEPT = "not_kept"  # approved or locked by a version that kept no signatures
    ENDED = "ended"  # of a lock that holds no more


@dataclass(frozen=True)
class Signer:
    """A person whose password was checked a moment ago; `app.accounts.sign_on` makes them, and nothing else should."""

    user_id: int
    label: str


def content_hash(content: Mapping[str, Any]) -> str:
    """Compute the SHA-256 of the canonical JSON of what is signed, 64 hexadecimal digits.

    Canonical, after RFC 8785: members sorted by name, no spaces, UTF-8, and whole numbers without a fraction (10.0 as 10). So what comes
    back from the database has the hash of what went in.

    Raises:
        ValueError: a number that is not finite. TypeError: a value that JSON does not have.
    """
    text = json.dumps(_canonical(content), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def record(db: Session, signer: Signer, *, kind: str, subject_id: int, meaning: str, content: Mapping[str, Any]) -> Signature:
    """Store a signature of a person whose password was checked. Raises as `content_hash`."""
    signature = Signature(
        subject_kind=kind,
        subject_id=subject_id,
        meaning=meaning,
        sha256=content_hash(content),
        content=dict(content),
        signed_by=signer.user_id,
        signer=signer.label,
    )
    db.add(signature)
    db.flush()
    return signature


def covers(signature: Signature, content: Mapping[str, Any]) -> bool:
    """Check that a signature was given for exactly this content, and that its own record is whole and matches the audit trail."""
    return signature.sha256 == content_hash(content) == content_hash(signature.content) and _as_recorded(signature)


def changed_records(db: Session) -> list[int]:
    """List the numbers of the signatures whose content is not what was signed. The audit trail covers their other columns."""
    return [number for number, sha256, content in contents(db) if content_hash(content) != sha256]


def _as_recorded(signature: Signature) -> bool:
    """Check that the entry of the trail, in its place of the chain, has the same signature: hash, meaning, subject, who and when."""
    said = signature.recorded
    if said is None:
        return False
    same = all(said.get(name) == getattr(signature, name) for name in _RECORDED)
    return same and datetime.fromisoformat(said["signed_at"]) == signature.signed_at


def state_of(signature: Signature | None, content: Mapping[str, Any]) -> SignatureState:
    """Determine the state of a signature that is wanted, given the current content."""
    if signature is None:
        return SignatureState.NOT_KEPT
    return SignatureState.STANDS if covers(signature, content) else SignatureState.BROKEN


def _canonical(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _canonical(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical(v) for v in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < _EXACT:
        return int(value)
    return value
