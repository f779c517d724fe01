"""API tokens: what they may do, when they end, and what only a person who has signed in may change."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import timedelta

import pytest
from fastapi import FastAPI, Request
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session
from starlette.datastructures import URL

from app.accounts import service
from app.accounts.deps import COOKIE, caller_now
from app.accounts.permissions import PERMISSIONS, READ_ARMS, SCOPES, Caller, Grant
from app.platform.database import now
from app.platform.errors import Forbidden, Invalid, TooMany
from app.platform.numbers import when
from app.tables.accounts import Role, Scope, User
from tests.conftest import PASSWORD

ADA = "ada@clinic.example"


@pytest.fixture
def ada(db: Session) -> str:
    service.add_user(db, ADA, Role.ADMIN, PASSWORD)
    db.commit()
    return ADA


@pytest.fixture
def client_with(service_app: FastAPI) -> Callable[[str], TestClient]:
    """A client that calls with a token."""
    return lambda token: TestClient(service_app, headers={"Authorization": f"Bearer {token}"})


@pytest.mark.parametrize("scope", list(Scope))
def test_a_scope_narrows_what_its_user_may_and_widens_nothing(scope: Scope) -> None:
    every = set().union(*PERMISSIONS.values())
    for role, allowed in PERMISSIONS.items():
        caller = Caller("x", 1, (Grant(1, None, role),), token_scope=scope)
        within = SCOPES[scope]
        assert {p for p in every if caller.may(p)} == (allowed if within is None else allowed & within)


def test_a_narrow_token_is_refused_in_words(db: Session, ada: str, client_with: Callable[[str], TestClient]) -> None:
    token = service.create_token(db, ada, "reader", Scope.READ)
    db.commit()
    client = client_with(token)
    assert client.get("/api/v1/participants").status_code == 200
    answer = client.post("/api/v1/participants", json={"code": "P9"})
    assert answer.status_code in (403, 422)
    upload = client.post("/api/v1/uploads", files={"file": ("a.csv", b"x")}, data={"participant": "P1"})
    assert upload.status_code == 403
    assert upload.json()["detail"] == "A token for 'read' may not do this ('upload')."


@pytest.mark.parametrize("scope", [s for s in Scope if s is not Scope.METRICS])
def test_a_scope_blinds_nobody_whose_role_may_know_what_ran(scope: Scope) -> None:
    for role, knows in ((Role.VIEWER, True), (Role.CLINICIAN, True), (Role.BLINDED_ASSESSOR, False)):
        assert Caller("x", 1, (Grant(1, None, role),), token_scope=scope).may(READ_ARMS, 1) is knows, role


@pytest.mark.parametrize("scope", [Scope.READ, Scope.UPLOAD, Scope.JOBS])
def test_a_narrow_token_of_an_administrator_changes_no_study(
    db: Session, ada: str, client_with: Callable[[str], TestClient], scope: Scope
) -> None:
    token = service.create_token(db, ada, "tablet", scope)
    db.commit()
    client, named = client_with(token), {"code": "other", "name": "Other"}
    changes = [
        client.post("/api/v1/studies", json=named),
        client.patch("/api/v1/studies/main", json={"name": "Other", "reason": "x"}),
        client.post("/api/v1/studies/main/sites", json=named),
        client.patch("/api/v1/studies/main/sites/main", json={"name": "Other", "reason": "x"}),
    ]
    assert [answer.status_code for answer in changes] == [403] * 4
    assert "Other" not in client.get("/api/v1/studies").text


def test_an_address_in_disguise_opens_nothing_more(
    db: Session, ada: str, client_with: Callable[[str], TestClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tokens for figures and blinded assessors open addresses by the one that is answered. The address that the framework puts together
    from the host header does not count.
    """
    service.add_user(db, "blind@clinic.example", Role.BLINDED_ASSESSOR, PASSWORD)
    figures = service.create_token(db, ada, "figures", Scope.METRICS)
    blinded = service.create_token(db, "blind@clinic.example", "tablet")
    db.commit()
    for token, open_to_it in ((figures, "/metrics"), (blinded, "/analyses")):
        assert client_with(token).get(open_to_it).status_code == 200
        monkeypatch.setattr(URL, "path", property(lambda _, said=open_to_it: said))
        for path in ("/api/v1/studies", "/audit"):
            assert client_with(token).get(path).status_code == 403, path
        monkeypatch.undo()


def test_a_token_ends_on_its_day(db: Session, ada: str) -> None:
    token = service.create_token(db, ada, "tablet", days=1)
    assert service.caller_of_token(db, token) is not None
    db.execute(text("update api_token set expires_at = :at"), {"at": now() - timedelta(seconds=1)})
    assert service.caller_of_token(db, token) is None


def test_the_last_use_of_a_token_is_kept_and_shown(db: Session, ada: str, client_with: Callable[[str], TestClient]) -> None:
    used, unused = service.create_token(db, ada, "used"), service.create_token(db, ada, "unused")
    cookie = service.sign_in(db, ada, PASSWORD)
    db.commit()
    assert client_with(used).get("/api/v1/studies").status_code == 200
    assert unused
    last = db.scalar(text("select last_used_at from api_token where name = 'used'"))
    assert now() - timedelta(minutes=1) < last <= now()
    page = TestClient(client_with(used).app, cookies={COOKIE: cookie}).get("/account").text
    shown = {
        name: re.findall(r"<td>(.*?)</td>", row)[3] for name in ("used", "unused") for row in re.findall(rf"<tr><td>{name}</td>.*", page)
    }
    assert shown["used"] == when(last)
    assert shown["unused"] == when(None)
    # seen again within the minute nothing is written, which every request would wait for; after it, it is
    client_with(used).get("/api/v1/studies")
    assert db.scalar(text("select last_used_at from api_token where name = 'used'")) == last
    db.execute(text("update api_token set last_used_at = now() - interval '2 hours' where name = 'used'"))
    db.commit()
    client_with(used).get("/api/v1/studies")
    assert db.scalar(text("select last_used_at from api_token where name = 'used'")) >= last


@pytest.mark.parametrize("days", [0, -1, service.MOST_TOKEN_DAYS + 1])
def test_a_token_has_an_end_within_reason(db: Session, ada: str, days: int) -> None:
    with pytest.raises(Invalid, match="cannot last"):
        service.create_token(db, ada, "tablet", days=days)


def test_a_new_password_ends_tokens_and_browser_sessions(db: Session, ada: str) -> None:
    token, cookie = service.create_token(db, ada, "tablet"), service.sign_in(db, ada, PASSWORD)
    db.commit()
    caller = service.caller_of_cookie(db, cookie)
    assert caller is not None
    assert caller.user_id is not None
    service.change_own_password(db, caller.user_id, PASSWORD, "another good password")
    db.commit()
    assert service.caller_of_token(db, token) is None
    assert service.caller_of_cookie(db, cookie) is None


def test_the_present_password_cannot_be_guessed_without_limit(db: Session, ada: str) -> None:
    user = db.query(User).filter_by(email=ada).one()
    for _ in range(service.FAILURES_ALLOWED):
        with pytest.raises(Forbidden, match="password is wrong"):
            service.change_own_password(db, user.id, "a wrong guess", "another good password")
    with pytest.raises(TooMany):
        service.change_own_password(db, user.id, PASSWORD, "another good password")


@pytest.mark.parametrize(
    ("path", "form"),
    [
        ("/account/tokens", {"name": "minted"}),
        ("/account/password", {"present": PASSWORD, "password": "another good password", "again": "another good password"}),
        ("/account/tokens/1/revoke", {}),
        ("/accounts", {"email": "eve@clinic.example", "role": "admin", "password": "another good password"}),
        ("/accounts/1/password", {"password": "another good password"}),
        ("/accounts/1/active", {"active": "no"}),
    ],
)
def test_a_token_changes_no_password_token_or_account(
    db: Session, ada: str, client_with: Callable[[str], TestClient], path: str, form: dict[str, str]
) -> None:
    token = service.create_token(db, ada, "tablet")
    db.commit()
    answer = client_with(token).post(path, data=form)
    assert answer.status_code == 403
    assert "may not change passwords, tokens or accounts" in answer.text
    assert db.execute(text("select count(*) from api_token")).scalar_one() == 1


def test_nobody_administers_a_user_without_any_access(db: Session, ada: str) -> None:
    """Such a user belongs to no study of the caller: the administrator of one site could take the account over."""
    service.add_user(db, "former@clinic.example", Role.VIEWER, PASSWORD).memberships.clear()
    db.flush()
    former = db.query(User).filter_by(email="former@clinic.example").one()
    study = service.study_of(db, None)
    assert not service.manages(Caller("x", 1, (Grant(study.id, None, Role.ADMIN),)), former)


@pytest.mark.parametrize("by", ["token", "cookie"])
def test_an_answer_that_lasts_learns_that_its_account_was_closed(db: Session, ada: str, by: str) -> None:
    """A job's event stream asks this every few seconds; asking keeps no idle session alive."""
    token = service.create_token(db, ada, "follower") if by == "token" else service.sign_in(db, ada, PASSWORD)
    db.execute(text("update sign_in set last_seen_at = now() - interval '5 minutes'"))
    db.commit()
    header = (b"authorization", f"Bearer {token}".encode()) if by == "token" else (b"cookie", f"{COOKIE}={token}".encode())
    look = caller_now(Request({"type": "http", "headers": [header]}))
    found = look(db)
    assert found is not None
    assert found.label == ada
    assert db.scalar(text("select count(*) from sign_in where last_seen_at > now() - interval '4 minutes'")) == 0
    db.execute(text("update app_user set active = false"))
    db.commit()
    db.expire_all()
    assert look(db) is None
