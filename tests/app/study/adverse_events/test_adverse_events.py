"""Adverse events: written down once, corrected in revisions, cleared by a clinician; until then what ran is unsafe."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from tests.app.evaluations import judge as judge
from tests.app.evaluations import judged
from tests.app.evaluations import policies as policies
from tests.conftest import PASSWORD

Clients = Callable[[str], TestClient]
Upload = Callable[..., int]
PATH = "/api/v1/participants/P1/adverse-events"
FALL = {"kind": "fall", "severity": "severe", "serious": True, "note": "broke a wrist"}


def add(client: TestClient, **values: Any) -> dict[str, Any]:
    answer = client.post(PATH, json=FALL | values)
    assert answer.status_code == 201, answer.text
    body: dict[str, Any] = answer.json()
    return body


def clear(client: TestClient, event: dict[str, Any]) -> Any:
    wanted = {"revision": event["revision"], "reason": "tripped over a cable"}
    return client.post(f"/api/v1/adverse-events/{event['id']}/clearance", json=wanted)


def verdicts(client: TestClient) -> dict[int, tuple[str, list[str]]]:
    body = client.get("/api/v1/participants/P1/ranking").json()
    return {p["policy_id"]: (p["decision"], [r["code"] for r in p["decision_reasons"]]) for p in body["policies"]}


def test_a_policy_is_unsafe_until_a_clinician_clears_what_happened_under_it(
    client: TestClient, upload: Upload, policies: list[int], judge: Callable[..., int], client_as: Clients
) -> None:
    a, b, _ = policies
    judge({a: judged(50.0), b: judged(49.0)})
    assert [verdict for verdict, _ in verdicts(client).values()] == ["test", "test"]
    session = upload("rl", level=0.6, policy=str(a))
    event = add(client, session_id=session)
    assert (event["policy_id"], event["blocks"]) == (a, True)
    verdict, reasons = verdicts(client)[a]
    assert (verdict, reasons[0]) == ("unsafe", "adverse_event")
    assert verdicts(client)[b][0] == "test"
    assert "serious adverse event" in client.get("/participants/P1/ranking").text
    assert "Serious adverse event, not cleared" in client.get(f"/sessions/{session}").text
    assert clear(client_as("engineer"), event).status_code == 403, "a clinician's word"
    cleared = clear(client_as("clinician"), event)
    assert (cleared.json()["blocks"], cleared.json()["cleared_reason"]) == (False, "tripped over a cable")
    assert verdicts(client)[a][0] == "test"
    change = FALL | {"note": "broke a hip", "revision": 2, "reason": "X-ray"}
    worse = client.put(f"/api/v1/adverse-events/{event['id']}", json=change).json()
    assert (worse["blocks"], worse["cleared_reason"]) == (True, None), "what was cleared is not what is known now"
    assert verdicts(client)[a][0] == "unsafe"


def test_what_ran_before_any_recording_is_uploaded_can_be_named(client: TestClient, policies: list[int], judge: Callable[..., int]) -> None:
    a, b, _ = policies
    judge({a: judged(50.0), b: judged(49.0)})
    visit = client.get("/api/v1/participants/P1/visits").json()["items"][0]["id"]
    add(client, visit_id=visit, policy_id=b)
    assert {i: verdict for i, (verdict, _) in verdicts(client).items()} == {a: "test", b: "unsafe"}


def test_an_entry_that_is_sent_twice_is_one_event(client: TestClient, participant_code: str) -> None:
    first = add(client, entry_key="tablet-7-1")
    assert add(client, entry_key="tablet-7-1")["id"] == first["id"]
    other = client.post(PATH, json=FALL | {"entry_key": "tablet-7-1", "note": "another fall"})
    assert (other.status_code, "says something else" in other.json()["detail"]) == (409, True)
    assert len(client.get(PATH).json()) == 1


def test_corrections_are_revisions_and_nothing_is_taken_back(client: TestClient, participant_code: str, db: Session) -> None:
    event = add(client)
    change = {"severity": "none", "revision": 1, "reason": "of another participant"}
    path = f"/api/v1/adverse-events/{event['id']}"
    assert client.put(path, json=change).json()["revision"] == 2
    assert client.put(path, json=change).status_code == 409, "read before somebody changed it"
    assert clear(client, event).json()["detail"].endswith("is not serious.")
    for table in ("adverse_event", "adverse_event_revision"):
        with pytest.raises(DBAPIError, match=r"never change|permission denied"):
            db.execute(text(f"delete from {table}"))
        db.rollback()
    assert "of another participant" in client.get("/audit?entity=adverse_event_revision").text


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"severity": "none"}, "cannot be serious"),
        ({"kind": None}, "say what happened"),
        ({"kind": "other", "note": " "}, "in the note"),
        ({"session_id": 999}, "no session 999"),
        ({"policy_id": 999}, "no policy 999"),
    ],
)
def test_what_cannot_be_is_refused_in_words(client: TestClient, participant_code: str, changed: dict[str, Any], words: str) -> None:
    answer = client.post(PATH, json=FALL | changed)
    assert answer.status_code in (404, 422)
    assert words in answer.text
    assert client.get(PATH).json() == []


def test_a_locked_visit_takes_events_and_a_blinded_assessor_may_write_one_down(
    client: TestClient, upload: Upload, client_as: Clients
) -> None:
    session = upload("cdbs")
    blinded = client_as("blinded_assessor")
    written = blinded.post(PATH, json=FALL | {"session_id": session})
    assert (written.status_code, written.json()["policy_id"]) == (201, None)
    assert blinded.get(PATH).status_code == 403
    visit = client.get(f"/api/v1/sessions/{session}").json()["visit_id"]
    assert client.post(f"/api/v1/visits/{visit}/lock", json={"reason": "complete", "password": PASSWORD}).status_code == 200
    assert add(client, session_id=session)["visit_id"] == visit, "harm is written down whenever it becomes known"


def test_the_page_writes_clears_and_keeps_what_was_refused(client: TestClient, upload: Upload) -> None:
    session, page = upload("cdbs"), "/participants/P1/adverse-events"
    refused = client.post(page, data={"kind": "other", "severity": "mild", "note": "", "session_id": str(session)})
    assert refused.status_code == 422
    assert f'value="{session}"' in refused.text
    sent = {"kind": "speech", "severity": "severe", "serious": "yes", "note": "slurred", "session_id": str(session)}
    done = client.post(page, data=sent, follow_redirects=False)
    assert done.headers["location"] == f"/sessions/{session}?done=event"
    assert "slurred" in client.get(f"/sessions/{session}").text
    event = client.get(PATH).json()[0]
    assert "serious, not cleared" in client.get(page).text
    form = {"revision": "1", "reason": "passed within a minute"}
    assert client.post(f"/adverse-events/{event['id']}/clearance", data=form, follow_redirects=False).status_code == 303
    assert "serious, cleared" in client.get(page).text


DETAILS = {"relation": "probable", "action": "stimulation_changed", "outcome": "recovering", "ended_at": "2026-03-02T11:00:00Z"}


def test_what_a_clinical_standard_asks_is_kept_corrected_and_exported(client: TestClient, upload: Upload) -> None:
    session = upload("random")
    began = {"occurred_at": "2026-03-02T10:00:00Z", "session_id": session}
    event = add(client, kind="gait", severity="moderate", serious=False, **began, **DETAILS)
    assert {name: event[name] for name in DETAILS} == DETAILS
    fields = {name: event[name] for name in ("kind", "severity", "serious", "note", *DETAILS)}
    change = fields | {"outcome": "recovered", "revision": 1, "reason": "seen again"}
    changed = client.put(f"/api/v1/adverse-events/{event['id']}", json=change).json()
    assert (changed["outcome"], changed["relation"], changed["revision"]) == ("recovered", "probable", 2)
    for path in ("/adverse-events", "/participants/P1/adverse-events"):
        page = client.get(path).text
        assert all(word in page for word in ("moderate", "probable", "stimulation changed", "recovered")), path
    with zipfile.ZipFile(io.BytesIO(client.get("/participants/P1/export.zip").content)) as package:
        (row,) = csv.DictReader(io.StringIO(package.read("P1/adverse_events.csv").decode()))
    known = {name: row[name] for name in ("severity", "serious", "relation", "action", "outcome", "session_id", "cleared")}
    assert known == {
        "severity": "moderate", "serious": "false", "relation": "probable", "action": "stimulation_changed", "outcome": "recovered",
        "session_id": str(session), "cleared": "false",
    }  # fmt: skip
    assert float(row["ended_day"]) - float(row["began_day"]) == pytest.approx(1 / 24, abs=1e-4)


def test_lasting_harm_is_serious_and_no_event_ends_before_it_began(client: TestClient, participant_code: str) -> None:
    for wrong, field in (({"outcome": "fatal", "serious": False}, "serious"), (DETAILS | {"occurred_at": "2026-03-02T12:00:00Z"}, "ended")):
        answer = client.post(PATH, json=FALL | wrong)
        assert answer.status_code == 422
        assert field in answer.text
    event = add(client, outcome="lasting_harm")
    assert clear(client, event).json()["outcome"] == "lasting_harm", "a clearance changes nothing that is known"


def test_the_list_of_all_events_has_those_alone_that_the_reader_may_see(
    client: TestClient, client_as: Clients, participant_code: str
) -> None:
    add(client)
    assert "broke a wrist" in client_as("monitor").get("/adverse-events").text
    assert client_as("blinded_assessor").get("/adverse-events").status_code == 403
