"""Signatures: the password again, what was signed and its hash, and that a change breaks it visibly."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import select, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.accounts.permissions import SYSTEM, Caller
from app.accounts.sign_on import sign
from app.platform.audit.signatures import content_hash, covers, signatures_of
from app.platform.errors import Forbidden, TooMany
from app.tables.accounts import Role, SignInAttempt
from app.tables.audit import AuditEvent, Signature

PASSWORD = "correct horse battery"
CONTENT: dict[str, Any] = {"order": ["cdbs", "rl"], "max_ma": 3.0, "note": "Łódź", "limits": {"b": 0.1, "a": None}}
FLAT = {"kind": "plan", "subject_id": 7, "meaning": "approved for use in this participant"}


def standing(db: Session, kind: str, subject_id: int, content: dict[str, Any]) -> Signature | None:
    newest = next(iter(signatures_of(db, kind, subject_id)), None)
    return newest if newest is not None and covers(newest, content) else None


@pytest.fixture
def ada(db: Session) -> Caller:
    user = accounts.add_user(db, "ada@clinic.example", Role.CLINICIAN, PASSWORD)
    db.commit()
    return accounts.caller_of(user)


def test_the_hash_is_of_the_content_and_not_of_its_spelling() -> None:
    assert content_hash({"a": 1, "b": [2.0, -0.0]}) == content_hash({"b": [2, 0], "a": 1.0})
    # SHA-256 of {"a":1,"b":[2,0]}, by sha256sum
    assert content_hash({"a": 1, "b": [2, 0]}) == "c22521b998da31ca84fe7f51e1f7b014b511222556ec323aae5ba1ca8d0ef6c1"
    assert content_hash({"a": 1}) != content_hash({"a": "1"})
    with pytest.raises(ValueError, match="JSON"):
        content_hash({"a": float("nan")})


def test_a_signature_stands_for_its_content_alone(db: Session, ada: Caller) -> None:
    signed = sign(db, ada, PASSWORD, **FLAT, content=CONTENT)
    db.commit()
    db.expire_all()
    assert (signed.signer, signed.signed_by, signed.meaning, signed.content) == (ada.label, ada.user_id, FLAT["meaning"], CONTENT)
    assert standing(db, "plan", 7, CONTENT) is signed
    assert standing(db, "plan", 7, CONTENT | {"max_ma": 3.1}) is None
    assert standing(db, "plan", 8, CONTENT) is None
    assert standing(db, "locks", 7, CONTENT) is None


def test_a_signature_is_never_changed_and_stands_in_the_audit_trail(db: Session, ada: Caller) -> None:
    sign(db, ada, PASSWORD, **FLAT, content=CONTENT)
    db.commit()
    event = db.scalars(select(AuditEvent).where(AuditEvent.entity == "signature")).one()
    assert event.after is not None
    assert (event.after["sha256"], "content" in event.after) == (content_hash(CONTENT), False)
    refused = {"update signature set content = '{}'": "never changed", "delete from signature": "permission denied"}
    for change, why in refused.items():
        with pytest.raises(DBAPIError, match=why):
            db.execute(text(change))
        db.rollback()


def test_a_record_that_was_tampered_with_does_not_stand(db: Session, owner_db: Session, ada: Caller) -> None:
    sign(db, ada, PASSWORD, **FLAT, content=CONTENT)
    db.commit()
    owner_db.execute(text("alter table signature disable trigger never_changed"))
    owner_db.execute(text("""update signature set content = '{"max_ma": 9}'"""))
    owner_db.commit()
    db.expire_all()
    assert standing(db, "plan", 7, CONTENT) is None
    db.rollback()


def test_a_wrong_password_signs_nothing_and_cannot_be_guessed_without_limit(db: Session, ada: Caller) -> None:
    for _ in range(accounts.FAILURES_ALLOWED):
        with pytest.raises(Forbidden, match="The password is wrong"):
            sign(db, ada, "a wrong guess", **FLAT, content=CONTENT)
    with pytest.raises(TooMany):
        sign(db, ada, PASSWORD, **FLAT, content=CONTENT)
    with pytest.raises(TooMany):
        accounts.sign_in(db, ada.label, PASSWORD)
    assert standing(db, "plan", 7, CONTENT) is None


def test_signing_commits_nothing_of_the_callers_transaction(db: Session, ada: Caller) -> None:
    sign(db, ada, PASSWORD, **FLAT, content=CONTENT)
    db.rollback()
    assert standing(db, "plan", 7, CONTENT) is None
    assert db.scalars(select(SignInAttempt)).all() == []


def test_a_closed_account_and_the_system_sign_nothing(db: Session, ada: Caller) -> None:
    with pytest.raises(Forbidden, match="Only a person"):
        sign(db, SYSTEM, PASSWORD, **FLAT, content=CONTENT)
    db.execute(text("update app_user set active = false"))
    db.commit()
    with pytest.raises(Forbidden):
        sign(db, ada, PASSWORD, **FLAT, content=CONTENT)
