"""Forms before anything is typed: labels, optional fields; and true words where data cannot be read."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

TEMPLATES = Path(__file__).resolve().parents[3] / "app" / "templates"


def test_a_session_that_cannot_be_read_says_why_and_nothing_else(
    browser: TestClient, client: TestClient, participant_code: str, table: bytes
) -> None:
    sides = [{"hemisphere": side, "amplitude_ma": 3.0} for side in ("left", "right")]
    assert client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 2, "cdbs_amplitudes": sides}).status_code == 201
    upload = {"participant": participant_code, "visit": "2", "controller": "cdbs"}
    answer = client.post("/api/v1/uploads", data=upload, files={"file": ("a.csv", table)})
    page = unescape(browser.get(f"/sessions/{answer.json()['sessions'][0]['id']}").text)
    assert "No hemisphere is named" in page
    assert "Set the session's hemisphere" in page
    assert "have none" not in page
    assert re.search(r'id="traces-\d+-0"', page)


@pytest.mark.parametrize("path", ["/sessions/{}", "/participants/P1/settings", "/participants/P1/upload", "/participants/P1/visits/new"])
def test_every_field_has_a_label_of_its_own(path: str, browser: TestClient, client: TestClient, session_id: int) -> None:
    client.put(f"/api/v1/sessions/{session_id}/qoc", json={"rating": 5})
    page = browser.get(path.format(session_id)).text
    ids = re.findall(r'\sid="([^"]*)"', page)
    assert sorted(ids) == sorted(set(ids))
    labels = re.findall(r'<label for="([^"]*)"', page)
    fields = [tag for tag in re.findall(r"<(?:input|select|textarea) [^>]*>", page) if 'type="hidden"' not in tag]
    assert len(fields) >= 5
    for tag in fields:
        own = re.search(r'\sid="([^"]*)"', tag)
        assert own, tag
        assert labels.count(own[1]) == 1, tag


def chosen_visit(page: str) -> str | None:
    visits = re.search(r'<select id="f-visit".*?</select>', page, re.S)
    assert visits
    assert '<option value="">by the date of the files' in visits[0]
    found = re.findall(r'<option value="(\d*)" selected', visits[0])
    assert len(found) <= 1
    return found[0] if found else None


def test_the_upload_form_leaves_the_visit_to_the_files_unless_a_link_named_one(browser: TestClient, client: TestClient) -> None:
    client.post("/api/v1/participants", json={"code": "P3"})
    for number, day in enumerate(("2026-03-02", "2026-03-30"), 1):
        assert client.post("/api/v1/participants/P3/visits", json={"number": number, "date": day}).status_code == 201
    assert chosen_visit(browser.get("/participants/P3/upload").text) is None
    assert chosen_visit(browser.get("/participants/P3/upload?visit=1").text) == "1"


def test_unit_and_source_of_a_tables_beta_are_stated_on_the_upload_page(
    browser: TestClient, client: TestClient, participant_code: str, table: bytes
) -> None:
    url = f"/participants/{participant_code}/upload"
    page = browser.get(url).text
    options = re.search(r'<select id="f-beta_source".*?</select>', page, re.S)
    assert options
    assert re.findall(r'<option value="([^"]*)"', options[0]) == ["", "time_domain", "device_power", "percept_lfp", "table"]
    fields = {"visit": "1", "controller": "cdbs", "beta_unit": "device units", "beta_source": "device_power"}
    sent = browser.post(url, data=fields, files=[("file", ("a.csv", table))])
    assert sent.status_code == 200
    session = client.get("/api/v1/visits/1/sessions").json()["items"][0]["id"]
    trace = client.get(f"/api/v1/sessions/{session}/trace").json()
    assert (trace["beta_unit"], trace["beta_source"]) == ("device units", "device_power")
    refused = browser.post(url, data=fields | {"beta_source": "hearsay"}, files=[("file", ("a.csv", table))])
    assert refused.status_code == 422
    assert "Source of beta" in refused.text
    assert 'value="device units"' in refused.text


def test_no_confirmation_can_be_read_backwards() -> None:
    """A button asks with what both answers do; where it names no answers of its own, its label is a verb with its object."""
    asked = 0
    for path in sorted(TEMPLATES.rglob("*.html")):
        if path.name == "macros.html":
            continue
        html = path.read_text()
        for tag, label in re.findall(r"<button([^>]*data-confirm=[^>]*)>([^<]*)<", html, re.S):
            asked += 1
            assert "data-confirm-yes=" in tag or len(label.split()) > 1, f"{path.name}: {label}"
        for call in re.findall(r"(?:post_button|call form)\([^{}]*?confirm=.*?\) ?(?:%\}|\}\})", html, re.S):
            asked += 1
            assert "yes=" in call, f"{path.name}: {call}"
            assert "no=" in call, f"{path.name}: {call}"
    assert asked >= 12
