"""The forms of files that wait, doses and data queries say at each field what is wrong with it, as in test_errors_at_fields."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.app.pages.entries.test_errors_at_fields import WHY, Sent, refused

UNKNOWN = b"Zeit;Signal;Strom\n" + "".join(f"{2 * k};{1 + k % 5};2.0\n" for k in range(1, 12)).encode()


@pytest.fixture
def files(browser: TestClient, client: TestClient, session_id: int) -> dict[str, int]:
    """Numbers of a table of unknown columns, of bytes that nothing reads, and of grasps without a session."""
    with_session = b"t_s,beta,amplitude_fraction\n" + b"".join(b"%d,1,0.7\n" % (2 * k) for k in range(-9, 30))
    together = {"t.csv": UNKNOWN, "noise.bin": b"\x00\x01 noise " * 20, "s.csv": with_session}
    alone = {"grasps.csv": b"t_s\n0\n0.5\n1\n1.5\n"}  # with one session they would be that session's
    numbers = {}
    for sent in (together, alone):
        answer = client.post("/api/v1/uploads", data={"participant": "P1"}, files=[("file", one) for one in sent.items()])
        assert answer.status_code == 201, answer.text
        numbers |= {f["name"].partition(".")[0]: f["id"] for f in answer.json()["files"]}
    return numbers


def test_forms_of_files_that_wait_say_errors_at_their_fields(browser: TestClient, files: dict[str, int]) -> None:
    table, noise, grasps = (files[name] for name in ("t", "noise", "grasps"))
    stated = {"name": "tables", "holds": "steps", "header_line": "1", "unit_lines": "0", "time_format": "seconds", "time_at": "end"}
    stated |= {"role_1": "time", "role_2": "beta", "unit_2": "a.u.", "role_3": "amplitude_ma", "unit_3": "mA"}
    mapping, decision, attach = f"/uploaded-files/{table}/mapping", f"/uploaded-files/{noise}/decision", f"/uploaded-files/{grasps}/session"
    kept = 'value="tables"'
    forms = [
        Sent(mapping, stated | {"rate_hz": "fast"}, "f-rate_hz", "'fast' is no number", 'value="fast"'),
        Sent(mapping, stated | {"zone": "UTC"}, "f-zone", "only written dates have a zone", 'value="UTC"'),
        Sent(mapping, stated | {"time_at": ""}, "f-time_at", "say whether a step", kept),
        Sent(mapping, stated | {"unit_3": ""}, "f-column_3", "state the unit of", kept),
        Sent(mapping, stated | {"channel_2": "c" * 30}, "f-column_2", "at most 20", kept),
        Sent(mapping, stated | {"role_1": ""}, "f-columns", "one column is the time", kept),
        Sent(decision, {"do": "discard", "reason": " "}, f"reason-{noise}", "Say why", f'id="reason-{noise}"'),
        Sent(attach, {"session_id": ""}, f"session_id-{grasps}", "No session was chosen", f'id="session_id-{grasps}"'),
        Sent(attach, {"session_id": "99999"}, f"session_id-{grasps}", "99999", f'id="session_id-{grasps}"'),
    ]
    assert refused(browser, forms) == {}


def test_forms_of_doses_and_data_queries_say_errors_at_their_fields(browser: TestClient, client: TestClient, session_id: int) -> None:
    home, visit = "/participants/P1", client.get("/api/v1/participants/P1/visits").json()["items"][0]["id"]
    day = {"drug": "levodopa", "mg": "100", "taken_at": "2000-01-01T09:00"}
    asked = {"session_id": str(session_id), "field": "controller", "text": "Is it right?"}
    query = client.post("/api/v1/participants/P1/data-queries", json=asked | {"session_id": session_id})
    assert query.status_code == 201, query.text
    number, answer = query.json()["id"], f"/data-queries/{query.json()['id']}/entries"
    ask, doses = f"{home}/data-queries", f"/visits/{visit}/doses"
    forms = [
        Sent(doses, day | {"mg": "many"}, "f-dose-mg", "'many' is no number", 'value="many"'),
        Sent(doses, day, "f-dose-taken_at", "is not near visit", 'value="2000-01-01T09:00"'),
        Sent(doses, day | {"taken_at": "2199-01-01T09:00"}, "f-dose-taken_at", "has not come yet", 'value="100"'),
        Sent(ask, asked | {"session_id": "99999"}, "f-query-session_id", "99999", 'value="99999"'),
        Sent(ask, asked | {"session_id": ""}, "f-query-session_id", "name one thing that is asked about", ">Is it right?</textarea>"),
        Sent(ask, asked | {"field": "weather"}, "f-query-field", "is asked about as one of", ">Is it right?</textarea>"),
        Sent(ask, asked | {"text": " "}, "f-query-text", "give a value", f'value="{session_id}"'),
        Sent(answer, {"state": "closed", "entries": "1", "text": WHY * 2}, f"f-closed-{number}-text", "at most 2000", WHY * 2),
    ]
    assert refused(browser, forms) == {}
    assert browser.post(answer, data=forms[-1].typed).text.count('class="field-note"') == 1, "and at that form alone"
    given = client.post(f"/api/v1/visits/{visit}/doses", json=day | {"mg": 100, "taken_at": client_day(client, visit)})
    assert given.status_code == 201, given.text
    dose = given.json()["id"]
    removal = [Sent(f"/doses/{dose}/removal", {"reason": " "}, f"f-removal-{dose}-reason", "give a value", f'id="f-removal-{dose}-reason"')]
    assert refused(browser, removal) == {}
    assert browser.post(removal[0].address, data={"reason": WHY}).text.count('class="field-note"') == 1, "not at the visit's correction too"


def client_day(client: TestClient, visit: int) -> str:
    """Return an hour of a visit's day, as the API takes it."""
    day: Any = client.get(f"/api/v1/visits/{visit}").json()["date"]
    return f"{day or '2026-01-05'}T09:00:00Z"
