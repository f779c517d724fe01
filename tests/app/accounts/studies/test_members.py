"""Memberships in the REST interface: listed, given and ended by administrators who have signed in, with a row of the audit trail each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.accounts import service as accounts
from app.accounts.permissions import READ
from app.cli import app
from app.platform.database import transaction
from app.tables.accounts import Role, Site
from app.tables.audit import AuditEvent
from tests.conftest import PASSWORD

MEMBERS = "/api/v1/studies/main/members"
ADA = "ada@clinic.example"


@pytest.fixture
def ada(client: TestClient) -> TestClient:
    """A user who reads the first study, signed in with a browser."""
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
    at_site = admin.put(MEMBERS, json={"email": ADA, "role": "monitor", "site": "main", "also": True})
    assert at_site.json() == everywhere | {"role": "monitor", "site": "main"}
    ends = [admin.post(f"{MEMBERS}/end", json={"email": ADA, "site": site}).status_code for site in ("main", None)]
    assert ends == [204, 204]
    assert ada.get("/api/v1/participants/P9").status_code == 404, "a role ends at once, for whatever is open"
    assert ADA not in {m["email"] for m in client.get(MEMBERS).json()}
    told = db.query(AuditEvent).filter(AuditEvent.entity == "membership", AuditEvent.actor == "admin@clinic.example")
    rows = [(e.action, (e.after or e.before or {})["role"]) for e in told.order_by(AuditEvent.id)]
    assert rows == [("update", "coordinator"), ("insert", "monitor"), ("delete", "monitor"), ("delete", "coordinator")]


PLACES = (None, "main", "north")


@pytest.mark.parametrize(("first", "second"), [(a, b) for a in PLACES for b in PLACES])
@pytest.mark.parametrize("also", [False, True])
def test_each_pair_of_commands_leaves_the_roles_that_its_sentence_names(
    client: TestClient, db: Session, tmp_path: Path, first: str | None, second: str | None, also: bool
) -> None:
    """`user add` and then `user role`: a role at one site ends the one at all sites, which would stay in force everywhere."""
    run = CliRunner().invoke
    (tmp_path / "password").write_text(PASSWORD)
    assert run(app, ["study", "site", "main", "north", "--name", "North"]).exit_code == 0
    begin = ["user", "add", ADA, "--role", "clinician", "--password-file", str(tmp_path / "password")]
    added = run(app, [*begin, *(["--site", first] if first else [])])
    assert added.exit_code == 0, added.output
    changed = run(app, ["user", "role", ADA, "coordinator", *(["--site", second] if second else []), *(["--also"] if also else [])])
    assert changed.exit_code == 0, changed.output
    roles = {first: "clinician"} | {second: "coordinator"}
    if first is None and second is not None and not also:
        del roles[None]
    assert {m["site"]: m["role"] for m in client.get(MEMBERS).json() if m["email"] == ADA} == roles
    for site, role in roles.items():
        assert f"{role} at {f'site {site}' if site else 'all sites'}" in changed.output
    assert ("sees no other site" in changed.output) is (None not in roles)
    member = accounts.repository.user_by_email(db, ADA)
    assert member is not None
    caller = accounts.caller_of(member)
    sites = {site.code: site.id for site in db.scalars(select(Site))}
    seen = {code for code, number in sites.items() if caller.may(READ, member.memberships[0].study_id, number)}
    assert seen == (set(sites) if None in roles else set(roles))


def test_a_site_that_is_not_there_gets_no_user(client: TestClient, tmp_path: Path) -> None:
    (tmp_path / "password").write_text(PASSWORD)
    begin = ["user", "add", ADA, "--role", "clinician", "--password-file", str(tmp_path / "password")]
    wrong = CliRunner().invoke(app, [*begin, "--site", "elsewhere"])
    assert wrong.exit_code != 0
    assert "has no site 'elsewhere'" in str(wrong.exception)
    assert ADA not in {m["email"] for m in client.get(MEMBERS).json()}


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
