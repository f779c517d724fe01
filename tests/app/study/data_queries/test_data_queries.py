"""Data queries: asked by a monitor, answered by who enters data, closed by who asked; the old value stays readable."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.accounts.models import Role
from app.platform.database import transaction
from tests.conftest import PASSWORD

HOME = "/api/v1/participants/P1/data-queries"


@pytest.fixture
def session_id(client: TestClient, enrolled: str) -> int:
    """A session of P1 whose rating was typed wrong."""
    rows = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,1\n" for k in range(-9, 12))
    sent = client.post(
        "/api/v1/uploads",
        data={"participant": enrolled, "visit": "1", "controller": "random"},
        files={"file": ("s.csv", rows)},
    )
    assert sent.status_code == 201, sent.text
    found = int(sent.json()["sessions"][0]["id"])
    assert client.put(f"/api/v1/sessions/{found}/qoc", json={"rating": 3}).status_code == 200
    return found


def test_a_query_is_asked_answered_by_a_correction_and_closed(
    client: TestClient, client_as: Callable[[str], TestClient], session_id: int, db: Session
) -> None:
    monitor, coordinator = client_as("monitor"), client_as("coordinator")
    asked = monitor.post(HOME, json={"session_id": session_id, "field": "rating", "text": "The form says 8."})
    assert asked.status_code == 201, asked.text
    query = asked.json()
    assert (query["state"], query["entries"][0]["value"], query["entries"][0]["entered_by"]) == ("open", "3", "monitor@clinic.example")
    entries = f"/api/v1/data-queries/{query['id']}/entries"
    early = monitor.post(entries, json={"state": "answered", "text": "8", "entries": 1})
    assert early.status_code == 403  # who asks does not answer
    corrected = {"rating": 8, "reason": "read from the form"}
    assert coordinator.put(f"/api/v1/sessions/{session_id}/qoc", json=corrected).status_code == 200
    answered = coordinator.post(entries, json={"state": "answered", "text": "Typed wrong; corrected.", "entries": 1})
    assert answered.status_code == 201, answered.text
    assert monitor.post(entries, json={"state": "closed", "text": "Seen.", "entries": 1}).status_code == 409  # has not read the answer
    closed = monitor.post(entries, json={"state": "closed", "text": "Seen.", "entries": 2}).json()
    assert [(e["state"], e["value"]) for e in closed["entries"]] == [("open", "3"), ("answered", "8"), ("closed", "8")]
    assert [q["id"] for q in monitor.get(HOME, params={"state": "closed"}).json()] == [query["id"]]
    assert monitor.get(HOME, params={"state": "open"}).json() == []
    trail = db.execute(text("select actor, action from audit_event where entity = 'data_query_entry' order by id")).all()
    assert [tuple(row) for row in trail] == [
        ("monitor@clinic.example", "insert"), ("coordinator@clinic.example", "insert"), ("monitor@clinic.example", "insert"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("draft", "status"),
    [
        ({"session_id": 1, "upload_id": 1, "field": "other", "text": "?"}, 422),
        ({"field": "rating", "text": "?"}, 422),
        ({"upload_id": 1, "field": "rating", "text": "?"}, 422),
        ({"session_id": 1, "field": "file", "text": "?"}, 422),
        ({"session_id": 1, "field": "rating", "text": "  "}, 422),
        ({"session_id": 99, "field": "rating", "text": "?"}, 404),
        ({"upload_id": 99, "field": "file", "text": "?"}, 404),
        ({"upload_id": 1, "field": "file", "text": "Is this the whole folder?"}, 201),
    ],
)
def test_what_can_be_asked_about(client: TestClient, session_id: int, draft: dict[str, object], status: int) -> None:
    assert session_id == 1
    assert client.post(HOME, json=draft).status_code == status


def test_a_controller_is_asked_about_without_telling_it(client: TestClient, session_id: int) -> None:
    asked = client.post(HOME, json={"session_id": session_id, "field": "controller", "text": "The log says cDBS."}).json()
    assert asked["entries"][0]["value"] is None


def test_a_blinded_assessor_neither_reads_queries_nor_is_led_to_them(
    client: TestClient, client_as: Callable[[str], TestClient], session_id: int
) -> None:
    assert client.post(HOME, json={"session_id": session_id, "field": "controller", "text": "The log says cDBS."}).status_code == 201
    assert "data-queries" in client.get(f"/sessions/{session_id}").text
    blinded = client_as("blinded_assessor")
    assert blinded.get(f"/sessions/{session_id}").status_code == 403
    visit = client.get(f"/api/v1/sessions/{session_id}").json()["visit_id"]
    assert client.post(f"/api/v1/visits/{visit}/lock", json={"reason": "data complete", "password": PASSWORD}).status_code == 200
    page = blinded.get(f"/sessions/{session_id}")
    assert (page.status_code, "data-queries" in page.text) == (200, False)
    for closed in (HOME, "/participants/P1/data-queries"):
        assert blinded.get(closed).status_code == 403


def test_the_page_asks_answers_and_closes(client: TestClient, service_app, session_id: int) -> None:  # type: ignore[no-untyped-def]
    with transaction("test") as db:
        accounts.add_user(db, "cora@clinic.example", Role.COORDINATOR, PASSWORD)
    page = TestClient(service_app)
    page.post("/sign-in", data={"email": "cora@clinic.example", "password": PASSWORD})
    home = "/participants/P1/data-queries"
    assert "Nobody has asked" in page.get(home).text
    empty = page.post(home, data={"session_id": str(session_id), "field": "rating", "text": " "})
    assert empty.status_code == 422
    asked = page.post(home, data={"session_id": str(session_id), "upload_id": "", "field": "rating", "text": "The form says 8."})
    assert "It waits for an answer" in asked.text
    assert "1 data query not closed" in page.get(f"/sessions/{session_id}").text
    answered = page.post("/data-queries/1/entries", data={"state": "answered", "text": "It does.", "entries": "1"})
    assert "Whoever asks closes the query" in answered.text
    closed = page.post("/data-queries/1/entries", data={"state": "closed", "text": "Seen.", "entries": "2"})
    assert "Query closed." in closed.text
    assert "value then: <b>3</b>" in closed.text
    assert "not closed</" not in page.get(f"/sessions/{session_id}").text
