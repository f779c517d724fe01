"""Studies, sites and roles: who may make them, and what a role then opens and shuts."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from app import cli
from app.accounts import service as accounts
from app.accounts.permissions import SYSTEM
from app.accounts.studies import grant, study_to_manage
from app.platform.database import transaction
from app.tables.accounts import Role
from tests.conftest import PASSWORD

Clients = Callable[[str], TestClient]


def add_second(client: TestClient) -> None:
    """Add a second study with two sites, made by the administrator of the first."""
    made = client.post("/api/v1/studies", json={"code": "ADAPT", "name": "Adaptive", "site": {"code": "north", "name": "North"}})
    assert made.status_code == 201, made.text
    assert client.post("/api/v1/studies/ADAPT/sites", json={"code": "south", "name": "South"}).status_code == 201


@pytest.fixture
def second(client: TestClient) -> None:
    add_second(client)


def browser(client: TestClient, email: str) -> TestClient:
    fresh = TestClient(client.app, base_url="http://testserver", follow_redirects=False)
    assert fresh.post("/sign-in", data={"email": email, "password": PASSWORD}).status_code == 303
    return fresh


def enrol(client: TestClient, code: str, site: str) -> int:
    return client.post("/api/v1/participants", json={"code": code, "site": site}).status_code


def test_a_study_and_its_sites_are_made_renamed_and_audited(client: TestClient, second: None) -> None:
    changed = client.patch("/api/v1/studies/ADAPT", json={"name": "Adaptive DBS", "reason": "protocol 2"}).json()
    north, south = ({"code": code, "name": code.capitalize(), "ended_at": None} for code in ("north", "south"))
    assert changed == {
        "code": "ADAPT", "name": "Adaptive DBS", "code_prefix": "ADAPT-", "ended_at": None, "sites": [north, south],
    }  # fmt: skip
    assert client.patch("/api/v1/studies/ADAPT/sites/south", json={"name": "S", "reason": "x"}).json() == south | {"name": "S"}
    assert client.post("/api/v1/studies", json={"code": "ADAPT", "name": "x"}).status_code == 409
    assert client.post("/api/v1/studies/ADAPT/sites", json={"code": "south", "name": "x"}).status_code == 409
    assert client.post("/api/v1/studies", json={"code": "../x", "name": "x"}).status_code == 422
    assert "protocol 2" in client.get("/audit?entity=study").text


def test_who_administers_one_study_makes_none_and_sees_no_other(client: TestClient, client_as: Clients) -> None:
    clinician = client_as("clinician")
    add_second(client)
    assert [s["code"] for s in clinician.get("/api/v1/studies").json()] == ["main"]
    assert clinician.post("/api/v1/studies", json={"code": "mine", "name": "x"}).status_code == 403
    assert clinician.patch("/api/v1/studies/ADAPT", json={"name": "x", "reason": "x"}).status_code == 404
    assert clinician.patch("/api/v1/studies/main", json={"name": "x", "reason": "x"}).status_code == 403


def test_a_role_holds_at_its_site_alone_and_ends_at_once(client: TestClient, client_as: Clients) -> None:
    person = client_as("viewer")
    add_second(client)
    assert [enrol(client, code, site) for code, site in (("ADAPT-N1", "north"), ("ADAPT-S1", "south"))] == [201, 201]
    admin = browser(client, "admin@clinic.example")
    given = admin.post("/studies/ADAPT/members", data={"email": "viewer@clinic.example", "role": "coordinator", "site": "north"})
    assert given.headers["location"] == "/studies?done=member"
    seen = {p["code"] for p in person.get("/api/v1/participants").json()["items"]}
    assert seen == {"ADAPT-N1"}
    assert person.get("/api/v1/participants/ADAPT-S1").status_code == 404
    visits = [person.post(f"/api/v1/participants/{code}/visits", json={"number": 1}).status_code for code in ("ADAPT-N1", "ADAPT-S1")]
    assert visits == [201, 404]
    ended = admin.post("/studies/ADAPT/members/end", data={"email": "viewer@clinic.example", "site": "north"})
    assert ended.status_code == 303
    assert person.get("/api/v1/participants/ADAPT-N1").status_code == 404


@pytest.mark.parametrize(
    ("role", "enrols", "settings", "plans", "audit"),
    [("monitor", 403, 403, 403, 200), ("coordinator", 201, 403, 403, 200)],
)
def test_what_monitors_and_coordinators_may(
    client: TestClient, participant_code: str, client_as: Clients, role: str, enrols: int, settings: int, plans: int, audit: int
) -> None:
    person = client_as(role)
    assert person.get(f"/api/v1/participants/{participant_code}").status_code == 200
    assert enrol(person, "P9", "main") == enrols
    changed = person.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": {"cdbs_amplitude_ma": 3.0}, "reason": "x"})
    assert changed.status_code == settings
    visit = client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 77}).json()["id"]
    assert person.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [1]}).status_code == plans
    assert person.get("/audit").status_code == audit


def test_nobody_changes_the_own_role_and_no_token_gives_one(client: TestClient, second: None) -> None:
    admin = browser(client, "admin@clinic.example")
    own = admin.post("/studies/main/members", data={"email": "admin@clinic.example", "role": "viewer", "site": ""})
    assert own.status_code == 422
    assert "your own role" in own.text
    by_token = client.post("/studies/main/members", data={"email": "x@clinic.example", "role": "admin", "site": ""})
    assert by_token.status_code == 403


def test_a_blinded_assessor_gets_no_second_role(client: TestClient, client_as: Clients) -> None:
    client_as("blinded_assessor")
    add_second(client)
    admin = browser(client, "admin@clinic.example")
    both = admin.post("/studies/main/members", data={"email": "blinded_assessor@clinic.example", "role": "viewer", "site": "main"})
    assert both.status_code == 422
    assert "no other role in the study" in both.text


def test_nobody_blinds_who_works_in_a_study_of_others(client: TestClient, client_as: Clients) -> None:
    """A blinded assessor is blinded in every study: the role would close the other study to them."""
    client_as("clinician")
    add_second(client)
    with transaction("test") as db:
        accounts.add_user(db, "eve@clinic.example", Role.ADMIN, PASSWORD, study_code="ADAPT")
        accounts.add_user(db, "own@clinic.example", Role.VIEWER, PASSWORD, study_code="ADAPT")
    eve = browser(client, "eve@clinic.example")
    wanted = {"email": "clinician@clinic.example", "role": "blinded_assessor"}
    refused = eve.post("/studies/ADAPT/members", data=wanted)
    assert refused.status_code == 403
    assert "works in a study that you do not administer" in refused.text
    assert eve.post("/studies/ADAPT/members", data=wanted | {"role": "viewer"}).status_code == 303
    assert eve.post("/studies/ADAPT/members", data=wanted | {"email": "own@clinic.example"}).status_code == 303


@pytest.mark.parametrize("named", ["", "main", "nothing"])
def test_an_administrator_of_one_study_is_not_told_of_others(client: TestClient, client_as: Clients, named: str) -> None:
    add_second(client)
    assert client.post("/api/v1/studies", json={"code": "HIDDEN7", "name": "Another"}).status_code == 201
    with transaction("test") as db:
        accounts.add_user(db, "eve@clinic.example", Role.ADMIN, PASSWORD, study_code="ADAPT")
    eve = browser(client, "eve@clinic.example")
    person = {"email": "new@clinic.example", "role": "viewer", "study": named, "password": "another good password"}
    answer = eve.post("/accounts", data=person)
    assert answer.status_code == (404 if named else 303), "without a study it is the only one that she administers"
    assert "HIDDEN7" not in answer.text


def test_the_command_line_does_the_same(client: TestClient) -> None:
    with transaction("test") as db:
        accounts.add_user(db, "ada@clinic.example", Role.VIEWER, PASSWORD)
    run = CliRunner().invoke
    assert run(cli.app, ["study", "add", "ADAPT", "--name", "Adaptive", "--site", "north"]).exit_code == 0
    assert run(cli.app, ["study", "site", "ADAPT", "south", "--name", "South"]).exit_code == 0
    given = run(cli.app, ["user", "role", "ada@clinic.example", "coordinator", "--study", "ADAPT", "--site", "south"])
    assert given.exit_code == 0, given.output
    page = browser(client, "ada@clinic.example").get("/api/v1/studies").json()
    assert [s["code"] for s in page] == ["main", "ADAPT"]
    assert run(cli.app, ["user", "role", "ada@clinic.example", "none", "--study", "ADAPT", "--site", "south"]).exit_code == 0
    assert [s["code"] for s in browser(client, "ada@clinic.example").get("/api/v1/studies").json()] == ["main"]


def test_the_page_shows_members_and_keeps_others_out(client: TestClient, client_as: Clients) -> None:
    clinician = client_as("clinician")
    add_second(client)
    text = browser(client, "admin@clinic.example").get("/studies").text
    assert "Adaptive" in text
    assert "admin@clinic.example" in text
    assert clinician.get("/studies").status_code == 403


def test_sites_of_one_code_in_two_studies_are_told_apart(client: TestClient, second: None) -> None:
    assert client.post("/api/v1/studies/main/sites", json={"code": "north", "name": "North"}).status_code == 201
    refused = client.post("/api/v1/participants", json={"code": "P9", "site": "north"})
    assert refused.status_code == 422
    assert "ADAPT/north, main/north" in refused.json()["hint"]
    assert enrol(client, "ADAPT-9", "ADAPT/north") == 201
    assert 'value="main/north"' in client.get("/participants/new").text
    form = {"code": "P10", "site": "main/north", "beta_unit": "uV", "beta_source": "table"}
    assert client.post("/participants", data=form, follow_redirects=False).status_code == 303
    assert client.get("/api/v1/participants/P10").json()["site"] == "north"


def test_who_enrols_in_one_study_alone_names_no_site(client: TestClient, second: None) -> None:
    with transaction("test") as db:
        accounts.add_user(db, "both@clinic.example", Role.COORDINATOR, PASSWORD, study_code="main")
        grant(db, study_to_manage(db, "ADAPT", SYSTEM), "both@clinic.example", Role.VIEWER, None, SYSTEM)
    both = browser(client, "both@clinic.example")
    assert 'name="site"' not in both.get("/participants/new").text
    assert both.post("/participants", data={"code": "P9", "beta_unit": "uV", "beta_source": "table"}).status_code == 303
    assert client.get("/api/v1/participants/P9").json()["site"] == "main"
