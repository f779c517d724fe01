"""Passwords, lock-out, sessions and tokens."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from threading import Barrier
from typing import Any

import pytest
from pwdlib import PasswordHash
from pwdlib.hashers.argon2 import Argon2Hasher
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts import repository, service
from app.accounts.permissions import MANAGE_ACCOUNTS, PERMISSIONS, READ, READ_ARMS, SIGN_PLAN, WRITE_STUDY, Caller, Grant
from app.accounts.repository import normal_address
from app.platform.database import new_session
from app.platform.errors import Conflict, Forbidden, Invalid, NotFound, TooMany, Unauthorized
from app.tables.accounts import Role

EMAIL, PASSWORD = "ada@clinic.example", "correct horse battery"


@pytest.fixture
def ada(db: Session) -> str:
    service.add_user(db, "Ada@Clinic.example", Role.CLINICIAN, PASSWORD)
    db.commit()
    return EMAIL


def test_a_password_opens_a_session_whose_token_is_not_stored(db: Session, ada: str) -> None:
    token = service.sign_in(db, "ADA@clinic.example ", PASSWORD)
    db.commit()
    caller = service.caller_of_cookie(db, token)
    assert caller is not None
    assert caller.label == ada
    stored = db.execute(text("select token_sha256 from sign_in")).scalar_one()
    assert token not in stored
    assert PASSWORD not in db.execute(text("select password_hash from app_user")).scalar_one()


def test_five_failures_lock_the_address_and_a_pause_unlocks_it(db: Session, ada: str) -> None:
    for _ in range(service.FAILURES_ALLOWED):
        with pytest.raises(Unauthorized):
            service.sign_in(db, ada, "wrong password")
        db.commit()
    with pytest.raises(TooMany):
        service.sign_in(db, ada, PASSWORD)
    db.execute(text("update sign_in_attempt set at = at - interval '16 minutes'"))
    db.commit()
    assert service.sign_in(db, ada, PASSWORD)


def test_unknown_address_and_wrong_password_sound_the_same(db: Session, ada: str) -> None:
    messages = set()
    for email in (ada, "nobody@clinic.example"):
        with pytest.raises(Unauthorized) as caught:
            service.sign_in(db, email, "wrong password")
        messages.add(str(caught.value))
    assert len(messages) == 1


def test_an_unknown_address_costs_as_much_as_a_known_one_of_an_earlier_version(
    db: Session, ada: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    dearer = PasswordHash((Argon2Hasher(time_cost=3, memory_cost=96, parallelism=1),)).hash(PASSWORD)
    db.execute(text("update app_user set password_hash = :hash"), {"hash": dearer})
    service.add_user(db, "new@clinic.example", Role.CLINICIAN, PASSWORD)
    db.commit()
    judged: list[str] = []

    class Watched(PasswordHash):
        def verify(self, password: str | bytes, hash: str | bytes) -> bool:
            judged.append(str(hash))
            return super().verify(password, hash)

    monkeypatch.setattr(service, "_hasher", Watched(service._hasher.hashers))
    for i in range(12):
        for _ in range(2):
            with pytest.raises(Unauthorized):
                service.sign_in(db, f"nobody{i}@clinic.example", PASSWORD)
    assert all(first == again for first, again in zip(judged[::2], judged[1::2], strict=True)), "an address always costs the same"
    assert dearer in judged, "and some of them what people of before cost"
    assert len(set(judged)) == 2
    assert service.sign_in(db, ada, PASSWORD)


@pytest.mark.parametrize("column", ["last_seen_at", "created_at"])
def test_a_session_ends_by_idling_and_by_age(db: Session, ada: str, column: str) -> None:
    token = service.sign_in(db, ada, PASSWORD)
    db.commit()
    db.execute(text(f"update sign_in set {column} = {column} - cast(:age as interval)"), {"age": timedelta(hours=13)})
    db.commit()
    assert service.caller_of_cookie(db, token) is None


def test_signing_out_ends_the_session(db: Session, ada: str) -> None:
    token = service.sign_in(db, ada, PASSWORD)
    service.sign_out(db, token)
    db.commit()
    assert service.caller_of_cookie(db, token) is None


def test_a_new_password_ends_every_session(db: Session, ada: str) -> None:
    token = service.sign_in(db, ada, PASSWORD)
    db.commit()
    from app.accounts import repository

    user = repository.user_by_email(db, ada)
    assert user is not None
    service.set_password(db, user, "another long password")
    db.commit()
    assert service.caller_of_cookie(db, token) is None
    with pytest.raises(Unauthorized):
        service.sign_in(db, ada, PASSWORD)


def test_a_token_works_until_it_is_revoked(db: Session, ada: str) -> None:
    token = service.create_token(db, ada, "tablet")
    db.commit()
    caller = service.caller_of_token(db, token)
    assert caller is not None
    assert caller.user_id is not None
    row = db.execute(text("select id from api_token")).scalar_one()
    service.revoke_token(db, caller.user_id, row)
    db.commit()
    assert service.caller_of_token(db, token) is None


def test_nobody_revokes_the_token_of_another(db: Session, ada: str) -> None:
    service.create_token(db, ada, "tablet")
    row = db.execute(text("select id from api_token")).scalar_one()
    with pytest.raises(NotFound):
        service.revoke_token(db, 10_000, row)


def test_names_of_tokens_and_addresses_are_unique(db: Session, ada: str) -> None:
    service.create_token(db, ada, "tablet")
    with pytest.raises(Conflict):
        service.create_token(db, ada, "tablet")
    with pytest.raises(Conflict):
        service.add_user(db, ada.upper(), Role.VIEWER, PASSWORD)


@pytest.mark.parametrize(("email", "password"), [("no address", PASSWORD), ("a@b.example", "short")])
def test_bad_accounts_are_refused(db: Session, email: str, password: str) -> None:
    with pytest.raises(Invalid):
        service.add_user(db, email, Role.VIEWER, password)


def test_roles_include_what_they_should() -> None:
    assert PERMISSIONS[Role.VIEWER] == {READ, READ_ARMS}
    assert READ_ARMS not in PERMISSIONS[Role.BLINDED_ASSESSOR]
    assert SIGN_PLAN in PERMISSIONS[Role.CLINICIAN]
    assert SIGN_PLAN not in PERMISSIONS[Role.ENGINEER]
    assert all(PERMISSIONS[r] <= PERMISSIONS[Role.ADMIN] for r in Role)
    assert MANAGE_ACCOUNTS not in PERMISSIONS[Role.CLINICIAN] | PERMISSIONS[Role.ENGINEER]


def test_a_grant_reaches_its_study_and_site_only() -> None:
    caller = Caller("x", 1, (Grant(1, 10, Role.CLINICIAN), Grant(2, None, Role.VIEWER)))
    caller.require(WRITE_STUDY, 1, 10)
    caller.require(READ, 2, 99)
    with pytest.raises(NotFound):
        caller.require(WRITE_STUDY, 1, 11)
    with pytest.raises(Forbidden):
        caller.require(WRITE_STUDY, 2, 99)
    with pytest.raises(NotFound):
        caller.require(READ, 3)


def test_a_zero_character_in_an_address_is_a_failed_sign_in_and_no_fault(db: Session, ada: str) -> None:
    with pytest.raises(Unauthorized):
        service.sign_in(db, "a\x00b@x", PASSWORD)
    db.commit()


PADDED = (
    EMAIL, f" {EMAIL}", f"{EMAIL} \t", EMAIL.upper(), f"{EMAIL}\u00a0", "\uff41da@clinic.example", "ada\uff20clinic.example",
    f"{EMAIL}\r\n",
)  # fmt: skip
NO_ADDRESS = (
    f"{EMAIL} \0 \0",
    f"\0{EMAIL}",
    "ada\u200b@clinic.example",
    "ada\x07@clinic.example",
    "ada\ud800@clinic.example",
    "",
    "x" * 300,
)


def test_padded_and_look_alike_spellings_are_one_address(db: Session, ada: str) -> None:
    assert {normal_address(spelling) for spelling in PADDED} == {EMAIL}
    for i in range(service.FAILURES_ALLOWED):
        with pytest.raises(Unauthorized):
            service.sign_in(db, PADDED[i], "wrong password")
    for spelling in PADDED:
        with pytest.raises(TooMany):
            service.sign_in(db, spelling, PASSWORD)
    assert db.execute(text("select distinct email from sign_in_attempt")).scalars().all() == [EMAIL]


@pytest.mark.parametrize("address", NO_ADDRESS)
def test_what_no_address_can_be_fails_like_a_wrong_password(db: Session, ada: str, address: str) -> None:
    def answer(to: str, password: str) -> tuple[str, str | None]:
        with pytest.raises(Unauthorized) as refused:
            service.sign_in(db, to, password)
        return refused.value.detail, refused.value.hint

    wrong = answer(EMAIL, "wrong password")
    assert wrong[0] == "The e-mail address or the password is wrong."
    assert answer(address, "wrong password") == answer(address, PASSWORD) == wrong
    assert service.sign_in(db, EMAIL, PASSWORD)


def test_guesses_at_the_same_moment_are_judged_no_more_often_than_allowed(db: Session, ada: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tries, count = 24, repository.recent_tries
    start = Barrier(tries)

    def slowly(*asked: Any) -> tuple[int, int]:
        found = count(*asked)
        time.sleep(0.05)  # as a busy database: who does not wait for the others counts none of their tries
        return found

    monkeypatch.setattr(repository, "recent_tries", slowly)

    def guess(number: int) -> str:
        with new_session() as own:
            start.wait()
            try:
                service.sign_in(own, PADDED[number % 5], f"wrong password {number}")
            except (Unauthorized, TooMany) as refused:
                own.commit()
                return type(refused).__name__
        return "let in"

    with ThreadPoolExecutor(tries) as pool:
        answers = list(pool.map(guess, range(tries)))
    assert sorted(answers) == sorted(["Unauthorized"] * service.FAILURES_ALLOWED + ["TooMany"] * (tries - service.FAILURES_ALLOWED))
    with pytest.raises(TooMany):
        service.sign_in(db, ada, PASSWORD)


def test_a_right_password_takes_the_failures_before_it_back(db: Session, ada: str) -> None:
    for _ in range(3):
        for _ in range(service.FAILURES_ALLOWED - 1):
            with pytest.raises(Unauthorized):
                service.sign_in(db, ada, "wrong password")
        assert service.sign_in(db, ada, PASSWORD)
        db.commit()
    assert db.execute(text("select count(*) from sign_in_attempt")).scalar_one() == 0


def test_tries_that_count_no_more_are_removed(db: Session, ada: str) -> None:
    for email in ("one@clinic.example", "two@clinic.example"):
        with pytest.raises(Unauthorized):
            service.sign_in(db, email, "wrong password")
    db.execute(text("update sign_in_attempt set at = at - interval '16 minutes'"))
    db.commit()
    with pytest.raises(Unauthorized):
        service.sign_in(db, ada, "wrong password")
    assert db.execute(text("select email from sign_in_attempt")).scalars().all() == [ada]
