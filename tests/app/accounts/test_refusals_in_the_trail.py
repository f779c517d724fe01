"""Refusals that a person may have to look into: lock-outs, and wrong passwords and codes where a password is asked for again."""

from __future__ import annotations

import time

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts import second_factor, service
from app.accounts.sign_on import sign
from app.platform.errors import Forbidden, TooMany, Unauthorized
from app.tables.accounts import Role, User
from app.tables.audit import AuditEvent

EMAIL, PASSWORD = "ada@clinic.example", "correct horse battery"


@pytest.fixture
def ada(db: Session) -> User:
    user = service.add_user(db, EMAIL, Role.CLINICIAN, PASSWORD)
    db.commit()
    return user


def refused(db: Session, entity: str) -> list[tuple[str, str, str]]:
    """List actor, subject and reason of every refusal in the trail."""
    rows = db.scalars(select(AuditEvent).where(AuditEvent.action == "refuse", AuditEvent.entity == entity).order_by(AuditEvent.id))
    return [(row.actor, row.entity_id, (row.after or {}).get("why", "")) for row in rows]


def guess(db: Session, address: str, times: int) -> None:
    for _ in range(times):
        with pytest.raises((Unauthorized, TooMany)):
            service.sign_in(db, address, "a wrong guess")


def test_a_lock_out_is_one_row_however_often_it_is_tried(db: Session, ada: User) -> None:
    guess(db, EMAIL, service.FAILURES_ALLOWED + 3)
    said = [why for _, address, why in refused(db, "sign_in") if address == EMAIL]
    assert said == [""] * service.FAILURES_ALLOWED + ["too many failed tries"]


def test_a_lock_out_of_an_unknown_address_keeps_nothing_of_what_was_typed(db: Session, ada: User) -> None:
    guess(db, "my secret passphrase", 1)
    guess(db, "nobody@clinic.example", service.FAILURES_ALLOWED + 1)
    assert {address for _, address, _ in refused(db, "sign_in")} == {"unknown address"}
    assert "too many failed tries" in {why for _, _, why in refused(db, "sign_in")}


def test_a_wrong_password_at_a_signature_is_in_the_trail(db: Session, ada: User) -> None:
    with pytest.raises(Forbidden):
        sign(db, service.caller_of(ada), "a wrong guess", kind="plan", subject_id=1, meaning="approved", content={})
    assert refused(db, "confirmation") == [(EMAIL, EMAIL, "The password is wrong.")]
    with pytest.raises(Forbidden):
        service.change_own_password(db, ada.id, "another wrong guess", "a new long password")
    assert len(refused(db, "confirmation")) == 2


def test_a_wrong_code_at_a_signature_is_in_the_trail(db: Session, ada: User) -> None:
    secret = second_factor.begin(db, ada)
    second_factor.confirm(db, ada, second_factor.code_of(secret, second_factor.step_at(time.time())))
    db.commit()
    with pytest.raises(Forbidden):
        service.confirm_password(ada.id, PASSWORD)
    assert refused(db, "confirmation") == [(EMAIL, EMAIL, "The code of the second factor is wrong or missing.")]


def test_a_lock_out_at_signatures_is_in_the_trail_too(db: Session, ada: User) -> None:
    for _ in range(service.FAILURES_ALLOWED + 2):
        with pytest.raises((Forbidden, TooMany)):
            service.confirm_password(ada.id, "a wrong guess")
    assert refused(db, "sign_in") == [(EMAIL, EMAIL, "too many failed tries")]
