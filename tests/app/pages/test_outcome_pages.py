"""The session page with the files behind the QoCs, its corrections, and the visit's correction form."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from html import unescape

import pytest
from fastapi.testclient import TestClient

from tests.app.pages.test_stale_forms import Tab

START = datetime(2026, 3, 2, 9, 0, tzinfo=UTC)


@pytest.fixture
def timed_session(client: TestClient, participant_code: str, table: bytes) -> int:
    """A session of 80 s from 09:00 UTC on, of the right hemisphere."""
    fields = {"participant": participant_code, "visit": "1", "controller": "cdbs", "started_at": START.isoformat(), "hemisphere": "right"}
    answer = client.post("/api/v1/uploads", data=fields, files={"file": ("one.csv", table)})
    assert answer.status_code == 201, answer.text
    return int(answer.json()["sessions"][0]["id"])


def send_tremor(client: TestClient, mild: float = 0.25) -> None:
    rows = ["time,mild,moderate,none,slight,strong,unknown"]
    rows += [f"{START.timestamp() + 60 * i:.0f},{mild},0,{0.75 - mild},0.15,0,0.1" for i in range(3)]
    answer = client.post("/api/v1/uploads", data={"participant": "P1"}, files={"file": ("tremor.csv", "\n".join(rows).encode())})
    assert answer.status_code == 201, answer.text


def test_both_readings_and_the_unknown_minutes_of_a_watch_stand_on_the_session_page(
    browser: TestClient, client: TestClient, timed_session: int
) -> None:
    send_tremor(client)
    page = unescape(browser.get(f"/sessions/{timed_session}").text)
    assert "Tremor by minute" in page
    assert "n = 2 minutes, 1.3 of 1.3 min of the session covered, 0.1 min unknown" in page
    assert re.search(r"Weighted by duration</dt><dd><b>25", page)
    assert "counts as the session's outcome" in page
    assert client.get(f"/api/v1/sessions/{timed_session}/qoc").json()["tremor_percent"] == pytest.approx(25.0)
    [told] = client.get(f"/api/v1/sessions/{timed_session}/outcomes").json()
    assert (told["name"], told["value"], told["conflicts"]) == ("tremor_percent", pytest.approx(25.0), False)


def test_a_typed_value_and_a_derived_one_are_both_shown_and_one_click_takes_the_derived(
    browser: TestClient, client: TestClient, timed_session: int
) -> None:
    qoc = f"/api/v1/sessions/{timed_session}/qoc"
    assert client.put(qoc, json={"tremor_percent": 5.0}).status_code == 200
    send_tremor(client)
    page = unescape(browser.get(f"/sessions/{timed_session}").text)
    assert "Tremor: two values" in page
    assert "<b>5.00 %</b>" in page
    assert "Use 25.00 % from the files" in page
    assert "does not count: a person's entry does" in page
    visit = client.get(f"/api/v1/sessions/{timed_session}").json()["visit_id"]
    assert "two values of tremor" in browser.get(f"/visits/{visit}").text
    tab = Tab(browser, f"/sessions/{timed_session}", f"/sessions/{timed_session}/derived")
    assert tab.send(value="24").status_code == 422
    assert client.get(qoc).json()["tremor_percent"] == 5.0
    assert tab.send().headers["location"].endswith("done=derived")
    stored = client.get(qoc).json()
    assert (stored["tremor_percent"], stored["derived"]) == (pytest.approx(25.0), ["tremor_percent"])
    assert stored["entered_by"] == "admin-page@clinic.example"
    assert "two values" not in browser.get(f"/sessions/{timed_session}").text


def test_grasp_intervals_are_shown_with_implausible_ones_marked(browser: TestClient, client: TestClient, timed_session: int) -> None:
    rows = "t_s,hand\n" + "\n".join(f"{t},L" for t in (0, 0.5, 1.0, 5.0, 5.5))
    fields = {"participant": "P1", "session": str(timed_session)}
    assert client.post("/api/v1/uploads", data=fields, files={"file": ("grasp.csv", rows.encode())}).status_code == 201
    page = unescape(browser.get(f"/sessions/{timed_session}").text)
    assert "n = 4 intervals in 1 test, 1 implausible" in page
    assert "without them 2 Hz" in page
    assert client.get(f"/api/v1/sessions/{timed_session}/qoc").json()["grasp_hz"] == pytest.approx(4 / 5.5)


def test_an_old_correction_form_takes_back_nothing_that_it_did_not_touch(browser: TestClient, client: TestClient, session_id: int) -> None:
    first, second = (Tab(browser, f"/sessions/{session_id}", f"/sessions/{session_id}/correction") for _ in range(2))
    assert first.send(controller="random", reason="misread").status_code == 303
    assert second.send(hemisphere="left", reason="forgotten").status_code == 303
    session = client.get(f"/api/v1/sessions/{session_id}").json()
    assert (session["controller"], session["hemisphere"]) == ("random", "left")


def test_two_corrections_of_one_field_are_a_conflict_that_keeps_what_was_typed(
    browser: TestClient, client: TestClient, session_id: int
) -> None:
    first, second = (Tab(browser, f"/sessions/{session_id}", f"/sessions/{session_id}/correction") for _ in range(2))
    assert first.send(controller="random", reason="misread").status_code == 303
    refused = second.send(controller="no_dbs", reason="my <reason>")
    assert refused.status_code == 409
    assert "stored now: random, by admin-page@clinic.example; you typed: no_dbs" in unescape(refused.text)
    assert client.get(f"/api/v1/sessions/{session_id}").json()["controller"] == "random"
    assert 'value="my &lt;reason&gt;"' in refused.text


def test_a_corrected_cdbs_amplitude_moves_the_fractions_of_the_visits_sessions(
    browser: TestClient, client: TestClient, session_id: int
) -> None:
    visit = client.get(f"/api/v1/sessions/{session_id}").json()["visit_id"]
    trace = f"/api/v1/sessions/{session_id}/trace"
    assert client.get(trace).json()["amplitude_fraction"][0] == pytest.approx(0.5)
    assert client.patch(f"/api/v1/sessions/{session_id}", json={"hemisphere": "left"}).status_code == 200
    tab = Tab(browser, f"/visits/{visit}", f"/visits/{visit}")
    assert tab.send(cdbs_left_0="2.5").status_code == 422  # no reason
    assert tab.send(cdbs_left_0="2.5", note="tired", reason="read from the wrong line").status_code == 303
    told = client.get(f"/api/v1/visits/{visit}").json()
    assert (told["note"], told["cdbs_amplitudes"]) == ("tired", [{"hemisphere": "left", "program": 0, "amplitude_ma": 2.5}])
    assert client.get(trace).json()["amplitude_fraction"][0] == pytest.approx(0.6)
    audit = unescape(browser.get("/audit").text)
    assert "read from the wrong line" in audit


def test_an_old_visit_form_leaves_alone_what_another_tab_corrected(browser: TestClient, client: TestClient, session_id: int) -> None:
    visit = client.get(f"/api/v1/sessions/{session_id}").json()["visit_id"]
    first, second, third = (Tab(browser, f"/visits/{visit}", f"/visits/{visit}") for _ in range(3))
    assert first.send(cdbs_right_1="2.5", reason="a").status_code == 303
    assert second.send(note="new", reason="b").status_code == 303
    refused = third.send(cdbs_right_1="2.0", reason="c")
    assert refused.status_code == 409
    assert "cDBS amplitude, right, program 1" in unescape(refused.text)
    assert "stored now: 2.5, by admin-page@clinic.example; you typed: 2.0" in unescape(refused.text)
    told = client.get(f"/api/v1/visits/{visit}").json()
    assert (told["note"], told["cdbs_amplitudes"]) == ("new", [{"hemisphere": "right", "program": 1, "amplitude_ma": 2.5}])


def test_a_visit_is_corrected_through_the_rest_interface_and_amplitudes_are_replaced_as_a_list(
    client: TestClient, participant_code: str
) -> None:
    both = [{"hemisphere": side, "program": 0, "amplitude_ma": 3.0} for side in ("left", "right")]
    visit = client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 2, "cdbs_amplitudes": both}).json()["id"]
    change = {"date": "2026-04-01", "cdbs_amplitudes": [both[0] | {"amplitude_ma": 2.0}], "reason": "right side is off"}
    told = client.patch(f"/api/v1/visits/{visit}", json=change).json()
    assert (told["date"], told["cdbs_amplitudes"]) == ("2026-04-01", [{"hemisphere": "left", "program": 0, "amplitude_ma": 2.0}])
    assert client.patch(f"/api/v1/visits/{visit}", json={"note": "x"}).status_code == 422  # no reason
    twice = {"cdbs_amplitudes": [both[0], both[0]], "reason": "twice"}
    assert client.patch(f"/api/v1/visits/{visit}", json=twice).status_code == 422


def test_a_proposed_session_is_named_as_such_and_counts_nowhere(
    browser: TestClient, client: TestClient, participant_code: str, table: bytes, session_id: int
) -> None:
    visit = client.get(f"/api/v1/sessions/{session_id}").json()["visit_id"]
    before = browser.get(f"/visits/{visit}").text
    suggested = client.get(f"/participants/{participant_code}/settings", headers={"Accept": "text/html"}).text
    fields = {"participant": participant_code, "visit": "1"}
    answer = client.post("/api/v1/uploads", data=fields, files={"file": ("two.csv", table.replace(b",2.00,", b",9.00,"))})
    [proposal] = answer.json()["proposals"]
    number = proposal["session"]["id"]
    page = browser.get(f"/visits/{visit}").text
    assert "to confirm" not in before
    assert "1 proposed session to confirm" in page
    assert f'href="/proposals/{number}"' in page
    assert f'href="/sessions/{number}"' not in page
    assert "1 proposed session to confirm" in browser.get(f"/participants/{participant_code}/visits").text
    again = client.get(f"/participants/{participant_code}/settings", headers={"Accept": "text/html"}).text
    found = [re.search(r"Use [\d.]+", p) for p in (suggested, again)]
    assert [m and m[0] for m in found] == [found[0] and found[0][0]] * 2
    assert browser.get(f"/sessions/{number}").headers["location"] == f"/proposals/{number}"
    assert client.put(f"/api/v1/sessions/{number}/qoc", json={"rating": 5}).status_code == 409
    assert client.post(f"/api/v1/sessions/{number}/outcomes", json={"name": "grasp_hz", "value": 1}).status_code == 409
