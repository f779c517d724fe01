"""Memberships in the REST interface: listed, given and ended by administrators who have signed in, with a row of the audit trail each."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.platform.database import transaction
from app.tables.accounts import Role
from app.tables.audit import AuditEvent
from tests.conftest import PASSWORD

MEMBERS = "/api/v1/studies/main/members"
ADA = "ada@clinic.example"


@pytest.fixture
def ada(client: TestClient) -> TestClient:
    """Somebody who reads the first study, signed in with a browser."""
    with transaction("test") as db:
        accounts.add_user(db, ADA, Role.VIEWER, PASSWORD)
    return browser(client, ADA)


def browser(client: TestClient, email: str) -> TestClient:
    fresh = TestClient(client.app, base_url="http://testserver", follow_redirects=False)
    assert fresh.post("/sign-in", data={"email": email, "password": PASSWORD}).status_code == 303
    return fresh


def test_a_role_is_listed_given_replaced_and_ended_with_audit(client: TestClient, ada: TestClient, db: Session) -> None:
    admin = browser(client, "admin@clinic.example")
    everywhere = {"email": ADA, "site": None, "active": True}
    assert everywhere | {"role": "viewer"} in client.get(MEMBERS).json()
    given = admin.put(MEMBERS, json={"email": "ADA@clinic.example", "role": "coordinator"})
    assert (given.status_code, given.json()) == (200, everywhere | {"role": "coordinator"})
    assert ada.post("/api/v1/participants", json={"code": "P9"}).status_code == 201
    at_site = admin.put(MEMBERS, json={"email": ADA, "role": "monitor", "site": "main"})
    assert at_site.json() == everywhere | {"role": "monitor", "site": "main"}
    ends = [admin.post(f"{MEMBERS}/end", json={"email": ADA, "site": site}).status_code for site in ("main", None)]
    assert ends == [204, 204]
    assert ada.get("/api/v1/participants/P9").status_code == 404, "a role ends at once, for whatever is open"
    assert ADA not in {m["email"] for m in client.get(MEMBERS).json()}
    told = db.query(AuditEvent).filter(AuditEvent.entity == "membership", AuditEvent.actor == "admin@clinic.example")
    rows = [(e.action, (e.after or e.before or {})["role"]) for e in told.order_by(AuditEvent.id)]
    assert rows == [("update", "coordinator"), ("insert", "monitor"), ("delete", "monitor"), ("delete", "coordinator")]


def test_no_token_gives_or_ends_a_role_and_a_stranger_sees_nobody(
    client: TestClient, ada: TestClient, client_as: Callable[[str], TestClient], db: Session
) -> None:
    """A token that got lost must not leave a role behind."""
    wanted = {"email": ADA, "role": "admin"}
    assert client.put(MEMBERS, json=wanted).status_code == 403
    assert client.post(f"{MEMBERS}/end", json={"email": ADA}).status_code == 403
    for role in ("viewer", "clinician"):
        other = client_as(role)
        assert other.get(MEMBERS).status_code == 403
    assert ada.put(MEMBERS, json=wanted).status_code == 403
    assert client.post("/api/v1/studies", json={"code": "ADAPT", "name": "Adaptive"}).status_code == 201
    with transaction("test") as own:
        accounts.add_user(own, "eve@clinic.example", Role.ADMIN, PASSWORD, study_code="ADAPT")
    eve = browser(client, "eve@clinic.example")
    answers = [eve.get(MEMBERS), eve.put(MEMBERS, json=wanted), eve.post(f"{MEMBERS}/end", json={"email": ADA})]
    assert [a.status_code for a in answers] == [404, 404, 404]
    assert {m.role for m in accounts.repository.user_by_email(db, ADA).memberships} == {"viewer"}  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("change", "status", "said"),
    [
        ({"email": "admin@clinic.example"}, 422, "your own role"),
        ({"email": "nobody@clinic.example"}, 404, "There is no user"),
        ({"site": "elsewhere"}, 404, "no site"),
        ({"role": "king"}, 422, ""),
    ],
)
def test_what_cannot_be_given_is_refused_in_words(
    client: TestClient, ada: TestClient, change: dict[str, str], status: int, said: str
) -> None:
    answer = browser(client, "admin@clinic.example").put(MEMBERS, json={"email": ADA, "role": "viewer"} | change)
    assert (answer.status_code, said in answer.text) == (status, True), answer.text
