"""A fresh sign-on in the place of a password: what it confirms, for whom, how long, and how often."""

# ruff: noqa: F811 (arguments are the fixtures that are imported)

from __future__ import annotations

import time

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.accounts import sign_on
from app.accounts.permissions import CONFIRMED_FOR, Caller
from app.accounts.sign_on import sign
from app.platform.database import new_session, now, set_actor
from app.platform.errors import Forbidden
from app.platform.web.templates import _environment
from app.tables.accounts import Role, User
from tests import identity_provider as theirs
from tests.app.accounts.test_sign_on import ADA, BOB, ada, browser, hospital, signed_on, trail  # noqa: F401
from tests.conftest import PASSWORD


def caller_in(browser: TestClient) -> Caller:
    with new_session() as db:
        caller = accounts.caller_of_cookie(db, browser.cookies["betaloop_session"])
    assert caller is not None
    return caller


def signs(browser: TestClient, password: str = "") -> None:
    caller = caller_in(browser)
    with new_session() as db:
        set_actor(db, caller.label, caller.user_id)
        sign(db, caller, password, kind="test", subject_id=1, meaning="read", content={"a": 1})
        db.commit()


def test_a_fresh_sign_on_stands_for_the_password_of_one_signature(
    browser: TestClient, hospital: theirs.Provider, ada: User, db: Session
) -> None:
    assert signed_on(browser).status_code == 303
    with pytest.raises(Forbidden, match="password is wrong"):
        signs(browser)
    back = signed_on(browser, "/sign-on/confirm?next=/account")
    assert (back.status_code, back.headers["location"]) == (303, "/account")
    assert hospital.asked == 2, "asked again, however lately they were"
    signs(browser)
    with pytest.raises(Forbidden):
        signs(browser)
    signs(browser, PASSWORD)
    assert db.scalar(text("select count(*) from signature")) == 2
    assert trail(db, "sign_in") == [("insert", ADA.email), ("update", ADA.email), ("update", ADA.email)]


def test_one_login_at_the_provider_stands_for_one_signature(browser: TestClient, hospital: theirs.Provider, ada: User, db: Session) -> None:
    assert signed_on(browser).status_code == 303
    login = int(hospital.last_login)
    hospital.change["auth_time"] = login  # a provider that does not ask again, though it must
    assert "has not asked you again" in signed_on(browser, "/sign-on/confirm").text, "the login of the sign-on signs nothing"
    hospital.change.clear()
    assert signed_on(browser, "/sign-on/confirm").status_code == 303
    signs(browser)
    hospital.change["auth_time"] = int(hospital.last_login)
    for begun in range(2):
        assert signed_on(browser, "/sign-on/confirm").status_code == 403, begun
        hospital.change["auth_time"] = login
    with pytest.raises(Forbidden):
        signs(browser)
    assert trail(db, "sign_on") == [("refuse", ADA.email)] * 3
    hospital.change.clear()
    assert signed_on(browser, "/sign-on/confirm").status_code == 303
    signs(browser)


def test_a_confirmation_runs_out_and_is_of_one_browser_session(browser: TestClient, ada: User, db: Session) -> None:
    assert signed_on(browser).status_code == 303
    assert signed_on(browser, "/sign-on/confirm").status_code == 303
    confirmed = caller_in(browser)
    with new_session() as other:
        token = accounts.sign_in(other, ADA.email, PASSWORD)
        other.commit()
        beside = accounts.caller_of_cookie(other, token)
        assert beside is not None
        with pytest.raises(Forbidden):
            sign_on.use_confirmation(other, beside)
    db.execute(text("update sign_in set confirmed_at = :at"), {"at": now() - CONFIRMED_FOR})
    db.commit()
    with new_session() as other, pytest.raises(Forbidden, match="sign within 5 minutes"):
        sign_on.use_confirmation(other, confirmed)


def test_nobody_else_confirms_and_an_old_sign_on_does_not(browser: TestClient, hospital: theirs.Provider, ada: User, db: Session) -> None:
    accounts.add_user(db, BOB.email, Role.CLINICIAN, PASSWORD)
    db.commit()
    for person in (BOB, ADA):  # both are known to the sign-on; the browser session is Ada's
        hospital.present, hospital.person = None, person
        browser.cookies.clear()
        assert signed_on(browser).status_code == 303
    hospital.person = BOB
    refused = signed_on(browser, "/sign-on/confirm")
    assert (refused.status_code, "Another person" in refused.text) == (403, True)
    hospital.person = ADA
    hospital.change["auth_time"] = int(time.time()) - 120
    assert "not asked you again" in signed_on(browser, "/sign-on/confirm").text
    with pytest.raises(Forbidden):
        signs(browser)
    assert browser.get("/account").status_code == 200, "Ada is still signed in"


def test_a_page_says_until_when_a_confirmation_stands_and_then_that_it_is_over(browser: TestClient, ada: User, db: Session) -> None:
    assert signed_on(browser).status_code == 303
    assert caller_in(browser).confirmed_until is None
    assert signed_on(browser, "/sign-on/confirm").status_code == 303
    caller = caller_in(browser)
    assert caller.confirmed_at is not None
    assert caller.confirmed_until == caller.confirmed_at + CONFIRMED_FOR
    form = _identity(caller)
    assert f"confirmed until {caller.confirmed_until:%H:%M:%S} UTC" in form
    assert '<p role="status" data-then hidden>' in form
    db.execute(text("update sign_in set confirmed_at = :at"), {"at": now() - CONFIRMED_FOR})
    db.commit()
    form = _identity(caller_in(browser))
    assert "confirmed until" not in form
    assert '<p role="status" data-then>' in form
    assert 'name="password" type="password" value="" required' in form


def _identity(caller: Caller) -> str:
    """Render the part of a signature's form that asks who signs."""
    macros = _environment.get_template("accounts/signing.html").make_module({})
    return str(macros.identity_again(caller, "/"))  # type: ignore[attr-defined]
