"""Participants' codes of two studies: each has its own beginning, and neither shows which codes the other study has."""

from __future__ import annotations

import re
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app import cli
from app.accounts import service as accounts
from app.accounts import studies
from app.platform.database import transaction
from app.platform.errors import Conflict
from app.tables.accounts import Role, Site, Study
from tests.conftest import PASSWORD


def add(client: TestClient, code: str, **more: Any) -> Any:
    return client.post("/api/v1/studies", json={"code": code, "name": "Another", **more})


def enrol(client: TestClient, code: str, site: str) -> Any:
    return client.post("/api/v1/participants", json={"code": code, "site": site})


def stranger(client: TestClient, study: str) -> TestClient:
    """Create a user who enrols in one study and sees no other."""
    with transaction("test") as db:
        accounts.add_user(db, f"eve@{study}.example", Role.COORDINATOR, PASSWORD, study_code=study)
        token = accounts.create_token(db, f"eve@{study}.example", "tests")
    return TestClient(client.app, headers={"Authorization": f"Bearer {token}"})


def test_who_enrols_learns_no_code_of_another_study(client: TestClient) -> None:
    """A code that the other study has and an unused one are answered alike, in the interface and on the page."""
    assert add(client, "ADAPT").json()["code_prefix"] == "ADAPT-"
    assert [enrol(client, code, site).status_code for code, site in (("ADAPT-7", "ADAPT"), ("P7", "main"))] == [201, 201]
    of_main, of_adapt = stranger(client, "main"), stranger(client, "ADAPT")
    pairs = [(of_main, "ADAPT-7", "ADAPT-8"), (of_main, "adapt-7", "adapt-8"), (of_adapt, "P7", "P8"), (of_adapt, "p7", "p8")]
    for who, there, nowhere in pairs:

        def said(answer: Any, there: str = there, nowhere: str = nowhere) -> str:
            """Return an answer without its own number, and as if it were about the unused code."""
            return re.sub(r'"request_id":"[0-9a-f]+"|(?<=request )[0-9a-f]{16}', "", answer.text).replace(there, nowhere)

        first, second = (who.post("/api/v1/participants", json={"code": code}) for code in (there, nowhere))
        assert (first.status_code, said(first)) == (422, said(second)), there
        read = [who.get(f"/api/v1/participants/{code}") for code in (there, nowhere)]
        assert (read[0].status_code, said(read[0])) == (404, said(read[1]))
        uploads = [
            who.post("/api/v1/uploads", data={"participant": code}, files={"file": ("a.csv", b"t_s\n")}) for code in (there, nowhere)
        ]
        assert (uploads[0].status_code, said(uploads[0])) == (404, said(uploads[1]))
        page = [who.post("/participants", data={"code": code}, headers={"Accept": "text/html"}) for code in (there, nowhere)]
        assert (page[0].status_code, said(page[0])) == (422, said(page[1]))
    taken = of_adapt.post("/api/v1/participants", json={"code": "ADAPT-7"})
    assert (taken.status_code, "already a participant" in taken.text) == (409, True), "of the own study it is said"
    assert of_adapt.post("/api/v1/participants", json={"code": "ADAPT-8"}).status_code == 201
    assert of_main.post("/api/v1/participants", json={"code": "P8"}).status_code == 201
    assert "begin with ADAPT-" in of_adapt.get("/participants/new").text


def test_a_prefix_is_not_held_for_a_name_and_the_rest_is(client: TestClient) -> None:
    assert add(client, "TREMBLE").status_code == 201
    assert enrol(client, "TREMBLE-3", "TREMBLE").status_code == 201
    named = enrol(client, "TREMBLE-Lee", "TREMBLE")
    assert [q["code"] for q in named.json()["questions"]] == ["name"]
    assert enrol(client, "TREMBLE-", "TREMBLE").status_code == 422, "nothing follows the prefix"


@pytest.mark.parametrize(
    ("prefix", "said"),
    [("adapt-", "cannot be distinguished"), ("AD", "cannot be distinguished"), ("ADAPT-N", "be distinguished"), ("P", "begin with 'P'")],
)
def test_prefixes_that_cannot_be_told_apart_or_are_in_use_are_refused(client: TestClient, prefix: str, said: str) -> None:
    assert add(client, "ADAPT").status_code == 201
    assert enrol(client, "P7", "main").status_code == 201
    refused = add(client, "NORTH", code_prefix=prefix)
    assert (refused.status_code, said in refused.text) == (409, True), refused.text
    assert [s["code"] for s in client.get("/api/v1/studies").json()] == ["main", "ADAPT"]


def test_a_code_too_long_for_a_prefix_asks_for_one(client: TestClient) -> None:
    asked = add(client, "a-study-with-a-long-code")
    assert (asked.status_code, "State a prefix" in asked.text) == (422, True)
    assert add(client, "a-study-with-a-long-code", code_prefix="L").json()["code_prefix"] == "L"


def test_a_study_of_earlier_versions_gets_its_prefix_once(client: TestClient, db: Session) -> None:
    """Its older codes stay, and until it has one another study without a prefix learns that a code is taken."""
    db.add(study := Study(code="old", name="Old"))
    db.flush()
    db.add(Site(study_id=study.id, code="old", name="Old"))
    db.commit()
    assert [enrol(client, code, "main").status_code for code in ("P7", "Q1")] == [201, 201]
    of_old = stranger(client, "old")
    assert of_old.post("/api/v1/participants", json={"code": "P7"}).status_code == 409, "as in earlier versions"
    run = CliRunner().invoke
    refused = run(cli.app, ["study", "prefix", "old", "P", "--reason", "own codes"])
    assert isinstance(refused.exception, Conflict)
    done = run(cli.app, ["study", "prefix", "old", "O-", "--reason", "own codes", "--json"])
    assert done.output == '{"study": "old", "code_prefix": "O-"}\n'
    answers = [of_old.post("/api/v1/participants", json={"code": code}).status_code for code in ("P7", "Q2", "O-1")]
    assert answers == [422, 422, 201]
    again = run(cli.app, ["study", "prefix", "old", "X", "--reason", "x"])
    assert "begin with 'O-'" in str(again.exception), "codes stand on paper by then"


def test_only_who_administers_all_studies_gives_a_prefix(client: TestClient) -> None:
    """An obstacle to a prefix may be another study's."""
    assert add(client, "ADAPT").status_code == 201
    with transaction("test") as db:
        accounts.add_user(db, "eve@clinic.example", Role.ADMIN, PASSWORD, study_code="main")
        token = accounts.create_token(db, "eve@clinic.example", "tests")
    eve = TestClient(client.app, headers={"Authorization": f"Bearer {token}"})
    assert eve.patch("/api/v1/studies/main", json={"code_prefix": "A", "reason": "x"}).status_code == 403
    assert eve.patch("/api/v1/studies/main", json={"reason": "x"}).status_code == 422
    assert eve.patch("/api/v1/studies/main", json={"name": "Main", "reason": "protocol"}).json()["code_prefix"] is None
    assert client.patch("/api/v1/studies/main", json={"code_prefix": "M-", "reason": "x"}).json()["code_prefix"] == "M-"


def test_a_prefix_waits_for_whoever_enrols(client: TestClient, fresh_database: str) -> None:
    """Between the look at prefixes and the new code no study can claim the code's beginning."""
    with transaction("first") as enrolling, transaction("second") as claiming:
        main = studies.study_by_code(enrolling, "main")
        assert main is not None
        assert studies.require_own(enrolling, main, "P9") == "P9"
        claiming.connection().exec_driver_sql("set lock_timeout = '200ms'")
        other = Study(code="late", name="Late")
        claiming.add(other)
        claiming.flush()
        with pytest.raises(Exception, match="lock timeout"):
            studies.claim(claiming, other, "P")
        claiming.rollback()
