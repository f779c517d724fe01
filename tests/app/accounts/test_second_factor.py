"""The second factor: codes as RFC 6238 has them, each of which works once; recovery codes; signing in, signing and removal ask for it."""

from __future__ import annotations

import base64
import hashlib
import re
import time
from concurrent.futures import ThreadPoolExecutor, wait

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app import cli
from app.accounts import second_factor, service, sign_on
from app.platform.database import new_session
from app.platform.errors import Forbidden, Invalid, Unauthorized
from app.tables.accounts import Role, User
from tests.conftest import PASSWORD

EMAIL = "ada@clinic.example"
RFC_SECRET = b"12345678901234567890"


@pytest.mark.parametrize(
    ("unix_s", "code"),
    # RFC 6238, appendix B, SHA-1, eight digits; an app shows the last six
    [(59, "94287082"), (1111111109, "07081804"), (1111111111, "14050471"), (1234567890, "89005924"), (2000000000, "69279037")],
)
def test_codes_are_those_of_the_standard(unix_s: int, code: str) -> None:
    assert second_factor.code_of(RFC_SECRET, second_factor.step_at(unix_s)) == code[2:]
    assert second_factor.matching_step(RFC_SECRET, code[2:], unix_s) == second_factor.step_at(unix_s)


def test_a_clock_may_be_a_step_off_and_no_code_works_twice() -> None:
    code = second_factor.code_of(RFC_SECRET, 100)
    assert [second_factor.matching_step(RFC_SECRET, code, 30 * step) for step in (98, 99, 100, 101, 102)] == [None, 100, 100, 100, None]
    assert second_factor.matching_step(RFC_SECRET, f" {code[:3]} {code[3:]} ", 3000) == 100
    assert second_factor.matching_step(RFC_SECRET, code, 3000, after=100) is None
    for wrong in ("", "000000", code + "0", "ü" * 6):
        assert second_factor.matching_step(RFC_SECRET, wrong, 3000) is None


def code_now(secret: bytes, later: int = 0) -> str:
    return second_factor.code_of(secret, second_factor.step_at(time.time()) + later)


@pytest.fixture
def ada(db: Session) -> tuple[User, bytes, list[str]]:
    """A user with a second factor, its secret and recovery codes."""
    user = service.add_user(db, EMAIL, Role.CLINICIAN, PASSWORD)
    secret = second_factor.begin(db, user)
    assert service.sign_in(db, EMAIL, PASSWORD)  # begun is not confirmed: the password alone does
    codes = second_factor.confirm(db, user, code_now(secret, -1))
    db.commit()
    return user, secret, codes


def test_signing_in_needs_a_code_that_was_not_used(db: Session, ada: tuple[User, bytes, list[str]]) -> None:
    _, secret, codes = ada
    said = set()
    for password, code in ((PASSWORD, ""), (PASSWORD, "000000"), ("wrong", code_now(secret))):
        with pytest.raises(Unauthorized) as refused:
            service.sign_in(db, EMAIL, password, code)
        said.add(str(refused.value))
    assert len(said) == 1  # which of them was wrong is not shown
    right = code_now(secret, 1)
    assert service.sign_in(db, EMAIL, PASSWORD, right)
    db.commit()
    with pytest.raises(Unauthorized):
        service.sign_in(db, EMAIL, PASSWORD, right)
    assert service.sign_in(db, EMAIL, PASSWORD, codes[3].upper())
    db.commit()
    with pytest.raises(Unauthorized):
        service.sign_in(db, EMAIL, PASSWORD, codes[3])


def test_signatures_and_a_new_password_need_a_code(db: Session, ada: tuple[User, bytes, list[str]]) -> None:
    user, secret, codes = ada
    signed = {"kind": "plan", "subject_id": 7, "meaning": "approved", "content": {"order": ["cdbs"]}}
    with pytest.raises(Forbidden, match="second factor"):
        sign_on.sign(db, service.caller_of(user), PASSWORD, **signed)  # type: ignore[arg-type]
    assert sign_on.sign(db, service.caller_of(user), PASSWORD, **signed, code=codes[0]).signer == EMAIL  # type: ignore[arg-type]
    db.commit()
    with pytest.raises(Forbidden, match="second factor"):
        service.change_own_password(db, user.id, PASSWORD, "another long one of words", "123456")
    service.confirm_password(user.id, PASSWORD, code_now(secret, 1))


def test_neither_the_database_nor_the_trail_holds_the_secret(db: Session, ada: tuple[User, bytes, list[str]]) -> None:
    _, secret, codes = ada
    kept = str(db.execute(text("select encode(sealed_secret, 'hex'), recovery::text from second_factor")).all())
    trail = str(db.execute(text("select before, after from audit_event where entity = 'second_factor'")).all())
    assert trail != "[]"
    for hidden in (secret.hex(), base64.b32encode(secret).decode(), codes[0], kept[3:40]):
        assert hidden not in trail
    for hidden in (secret.hex(), codes[0]):
        assert hidden not in kept


def test_recovery_codes_cannot_be_guessed_from_a_copy_of_the_database(db: Session, ada: tuple[User, bytes, list[str]]) -> None:
    _, _, codes = ada
    kept = db.scalars(text("select jsonb_array_elements_text(recovery) from second_factor")).all()
    assert len(kept) == second_factor.RECOVERY_CODES
    assert not {hashlib.sha256(code.encode()).hexdigest() for code in codes} & set(kept)


def test_of_two_first_codes_at_once_one_gives_recovery_codes(db: Session) -> None:
    user = service.add_user(db, EMAIL, Role.CLINICIAN, PASSWORD)
    code = code_now(second_factor.begin(db, user))
    db.commit()

    def confirm_beside() -> list[str]:
        with new_session() as other:
            codes = second_factor.confirm(other, other.get_one(User, user.id), code)
            other.commit()
            return codes

    with ThreadPoolExecutor(max_workers=1) as pool:
        codes = second_factor.confirm(db, user, code)
        beside = pool.submit(confirm_beside)
        wait([beside], timeout=0.5)  # it reads the row, or waits for it
        db.commit()
        with pytest.raises(Invalid, match="No second factor is being set up"):
            beside.result(timeout=60)
    assert second_factor.accepts(db, user.id, codes[0])


def test_the_account_page_sets_it_up_and_removes_it(service_app, db: Session) -> None:  # type: ignore[no-untyped-def]
    user = service.add_user(db, EMAIL, Role.VIEWER, PASSWORD)
    db.commit()
    page = TestClient(service_app)
    assert page.post("/sign-in", data={"email": EMAIL, "password": PASSWORD}, follow_redirects=False).status_code == 303
    for wrong in ({}, {"present": "wrong"}):
        refused = page.post("/account/second-factor", data=wrong)
        assert (refused.status_code, 'class="secret"' in refused.text) == (403, False)
    shown = page.post("/account/second-factor", data={"present": PASSWORD}).text
    key = re.search(r'<code class="secret">([A-Z2-7 ]+)</code>', shown)
    assert key is not None
    secret = base64.b32decode(key[1].replace(" ", ""))
    assert page.post("/account/second-factor/confirm", data={"code": "1"}).status_code == 422
    done = page.post("/account/second-factor/confirm", data={"code": code_now(secret, -1)}).text
    assert len(re.findall(r"\b[0-9a-f]{6}-[0-9a-f]{6}\b", done)) == second_factor.RECOVERY_CODES
    assert page.post("/sign-in", data={"email": EMAIL, "password": PASSWORD}, follow_redirects=False).status_code == 401
    signed_in = page.post("/sign-in", data={"email": EMAIL, "password": PASSWORD, "code": code_now(secret)}, follow_redirects=False)
    assert signed_in.status_code == 303
    assert page.post("/account/second-factor/remove", data={"present": PASSWORD, "code": "1"}).status_code == 403
    removed = page.post("/account/second-factor/remove", data={"present": PASSWORD, "code": code_now(secret, 1)})
    assert "Second factor removed" in removed.text
    assert not second_factor.wanted(db, user.id)


def test_an_administrator_of_the_machine_removes_a_lost_one(db: Session, ada: tuple[User, bytes, list[str]]) -> None:
    done = CliRunner().invoke(cli.app, ["user", "remove-second-factor", EMAIL])
    assert (done.exit_code, done.output.strip()) == (0, f"{EMAIL} signs in with the password alone now.")
    assert service.sign_in(db, EMAIL, PASSWORD)
