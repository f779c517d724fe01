"""Data queries: asked by a monitor, answered by who enters data, closed by who asked; the old value stays readable."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.platform.database import transaction
from app.tables.accounts import Role
from tests.conftest import PASSWORD

HOME = "/api/v1/participants/P1/data-queries"


@pytest.fixture
def session_id(client: TestClient, participant_code: str) -> int:
    """A session of P1 whose rating was typed wrong."""
    rows = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,1\n" for k in range(-9, 12))
    sent = client.post(
        "/api/v1/uploads",
        data={"participant": participant_code, "visit": "1", "controller": "random"},
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
        ({"visit_id": 1, "session_id": 1, "field": "other", "text": "?"}, 422),
        ({"visit_id": 1, "field": "rating", "text": "?"}, 422),
        ({"session_id": 1, "field": "nothing", "text": "?"}, 422),
        ({"record": "letters", "field": "other", "text": "?"}, 422),
        ({"record": "settings", "visit_id": 1, "field": "other", "text": "?"}, 422),
        ({"visit_id": 99, "field": "date", "text": "?"}, 404),
        ({"dose_id": 99, "field": "mg", "text": "?"}, 404),
        ({"event_id": 99, "field": "kind", "text": "?"}, 404),
    ],
)
def test_what_can_be_asked_about(client: TestClient, session_id: int, draft: dict[str, object], status: int) -> None:
    assert session_id == 1
    assert client.post(HOME, json=draft).status_code == status


@pytest.fixture
def values(client: TestClient, session_id: int) -> dict[str, int]:
    """A visit with a date, an amplitude and a dose, an adverse event at it, settings and characteristics, each with a wrong value."""
    visit = int(client.get(f"/api/v1/sessions/{session_id}").json()["visit_id"])
    amplitude = [{"hemisphere": "left", "amplitude_ma": 2.5}]
    change = {"date": "2026-03-02", "cdbs_amplitudes": amplitude, "note": "tired", "reason": "stated"}
    assert client.patch(f"/api/v1/visits/{visit}", json=change).status_code == 200
    dose = client.post(f"/api/v1/visits/{visit}/doses", json={"drug": "levodopa", "mg": 100, "taken_at": "2026-03-02T07:00:00Z"})
    event = client.post("/api/v1/participants/P1/adverse-events", json={"kind": "fall", "severity": "mild", "visit_id": visit})
    known = {"version": 0, "characteristics": {"hand": "left"}, "reason": "asked"}
    assert client.put("/api/v1/participants/P1/characteristics", json=known).status_code == 200
    return {"visit_id": visit, "dose_id": int(dose.json()["id"]), "event_id": int(event.json()["id"])}


ASKED: list[tuple[dict[str, str], str, str]] = [
    # its record, the value that was asked about, and what it was corrected to
    ({"visit_id": "", "field": "date"}, "2026-03-02", "2026-03-03"),
    ({"visit_id": "", "field": "cdbs_left"}, "2.5 mA", "3 mA"),
    ({"event_id": "", "field": "kind"}, "fall", "gait"),
    ({"event_id": "", "field": "serious"}, "false", "true"),
    ({"record": "settings", "field": "lower_bound"}, "0.3", "0.4"),
    ({"record": "characteristics", "field": "hand"}, "left", "right"),
]


def test_every_clinical_value_is_asked_about_and_keeps_its_old_value(
    client: TestClient, client_as: Callable[[str], TestClient], values: dict[str, int]
) -> None:
    monitor = client_as("monitor")
    queries = []
    for subject, before, _ in ASKED:
        named = subject | {name: values[name] for name in subject if name in values}
        asked = monitor.post(HOME, json=named | {"text": "The form says otherwise."})
        assert asked.status_code == 201, asked.text
        queries.append(asked.json())
        assert queries[-1]["entries"][0]["value"] == before, subject
        assert {name: queries[-1][name] for name in named} == named
    visit, event = values["visit_id"], values["event_id"]
    corrected = {"date": "2026-03-03", "cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": 3.0}], "reason": "form"}
    assert client.patch(f"/api/v1/visits/{visit}", json=corrected).status_code == 200
    worse = {"kind": "gait", "severity": "severe", "serious": True, "revision": 1, "reason": "form"}
    assert client.put(f"/api/v1/adverse-events/{event}", json=worse).status_code == 200
    lower = {"settings": {"lower_bound": 0.4}, "reason": "protocol"}
    assert client.put("/api/v1/participants/P1/settings", json=lower).status_code == 200
    other = {"version": 1, "characteristics": {"hand": "right"}, "reason": "asked again"}
    assert client.put("/api/v1/participants/P1/characteristics", json=other).status_code == 200
    for query, (subject, before, after) in zip(queries, ASKED, strict=True):
        said = {"state": "answered", "text": "Corrected.", "entries": 1}
        entries = client.post(f"/api/v1/data-queries/{query['id']}/entries", json=said).json()["entries"]
        assert [e["value"] for e in entries] == [before, after], subject


def test_the_value_of_a_dose_stays_readable_when_the_dose_is_taken_back(client: TestClient, values: dict[str, int]) -> None:
    asked = client.post(HOME, json={"dose_id": values["dose_id"], "field": "mg", "text": "100 or 1000?"}).json()
    assert asked["entries"][0]["value"] == "100.0"
    assert client.post(f"/api/v1/doses/{values['dose_id']}/removal", json={"reason": "not taken"}).is_success
    answered = client.post(f"/api/v1/data-queries/{asked['id']}/entries", json={"state": "answered", "text": "Taken back.", "entries": 1})
    assert answered.status_code == 201, answered.text
    assert answered.json()["entries"][0]["value"] == "100.0"
    assert "100 or 1000?" in client.get("/participants/P1/data-queries", headers={"Accept": "text/html"}).text


@pytest.mark.parametrize("number", ["99999999999999999999", "-1", "x", "\u0663", ""])
def test_a_form_about_no_number_is_the_common_one(client: TestClient, participant_code: str, number: str) -> None:
    page = client.get("/participants/P1/data-queries", params={"visit": number}, headers={"Accept": "text/html"})
    assert (page.status_code, 'name="session_id"' in page.text) == (200, True)
    sent = {"visit_id": number, "field": "date", "text": "?"}
    assert client.post("/participants/P1/data-queries", data=sent, headers={"Accept": "text/html"}).status_code in (404, 422)


def test_values_of_another_participant_are_not_asked_about(client: TestClient, values: dict[str, int]) -> None:
    assert client.post("/api/v1/participants", json={"code": "P2", "site": "main"}).status_code == 201
    for (name, number), field in zip(values.items(), ("date", "mg", "kind"), strict=True):
        draft = {name: number, "field": field, "text": "?"}
        assert client.post("/api/v1/participants/P2/data-queries", json=draft).status_code == 404


@pytest.mark.parametrize(
    ("page", "link", "offered", "draft"),
    [
        ("/visits/{visit_id}", "visit={visit_id}", "cDBS amplitude, left", {"visit_id": "{visit_id}", "field": "cdbs_left"}),
        ("/visits/{visit_id}", "dose={dose_id}", "Time it was taken", {"dose_id": "{dose_id}", "field": "mg"}),
        ("/participants/P1/adverse-events", "event={event_id}", "Severity", {"event_id": "{event_id}", "field": "severity"}),
        ("/participants/P1/settings", "record=settings", "Beta threshold", {"record": "settings", "field": "xi_beta"}),
        ("/participants/P1/characteristics", "record=characteristics", "Hand of the grasp test",
         {"record": "characteristics", "field": "hand"}),
    ],
)  # fmt: skip
def test_a_question_is_begun_beside_the_value(
    client: TestClient, values: dict[str, int], page: str, link: str, offered: str, draft: dict[str, str]
) -> None:
    address = f"/participants/P1/data-queries?{link.format(**values)}"
    assert f'href="{address}#new"' in client.get(page.format(**values), headers={"Accept": "text/html"}).text
    form = client.get(address, headers={"Accept": "text/html"}).text
    assert f">{offered}</option>" in form
    assert 'value="grasp_hz"' not in form, "fields of sessions stand in no other form"
    sent = {name: text.format(**values) for name, text in draft.items()}
    name, number = next(item for item in sent.items() if item[0] != "field")
    assert f'name="{name}" value="{number}"' in form
    refused = client.post("/participants/P1/data-queries", data=sent | {"text": " "}, headers={"Accept": "text/html"})
    assert refused.status_code == 422
    assert f'name="{name}" value="{number}"' in refused.text, "what was begun stays"
    asked = client.post("/participants/P1/data-queries", data=sent | {"text": "Sure?"}, headers={"Accept": "text/html"})
    assert "It waits for an answer" in asked.text
    said = {"cdbs_left": "cDBS amplitude, left", "mg": "dose", "hand": "hand of the grasp test", "xi_beta": "beta threshold"}
    assert f"Query 1: {said.get(draft['field'], draft['field'])}" in asked.text


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
    assert "data-queries" in client.get(f"/visits/{visit}").text
    for path in (f"/sessions/{session_id}", f"/visits/{visit}"):
        page = blinded.get(path)
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
