"""Forms that were opened before another person saved: nothing is taken back in silence, nothing typed is lost."""

from __future__ import annotations

import re
from collections.abc import Callable
from html import unescape

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform.web.forms import same_value
from tests.app.ingest.conftest import device_zip

STORED = {"grasp_hz": 2.4790827393, "rating": 5, "tremor_percent": 10.0}


def fields_of(page: str, action: str) -> dict[str, str]:
    """Return what the last form of an address sends when it is not touched."""
    form = page[page.rindex(f'action="{action}"') :]
    form = form[: form.index("</form>")]
    found = {}
    for tag in re.findall(r"<input [^>]*>", form):
        name, value = re.search(r'name="([^"]*)"', tag), re.search(r'value="([^"]*)"', tag)
        assert name, tag
        found[name[1]] = unescape(value[1]) if value else ""
    for name, options in re.findall(r'<select [^>]*name="([^"]*)"[^>]*>(.*?)</select>', form, re.S):
        chosen = re.search(r'value="([^"]*)" selected', options) or re.search(r'value="([^"]*)"', options)
        assert chosen, name
        found[name] = unescape(chosen[1])
    return found | {name: unescape(text) for name, text in re.findall(r'<textarea [^>]*name="([^"]*)"[^>]*>(.*?)</textarea>', form, re.S)}


def as_browsers_send(page: str, action: str) -> dict[str, str]:
    """Return what a browser sends of an untouched form: times without seconds where these are 0, and line breaks of two characters."""
    found = fields_of(page, action)
    timed = [tag for tag in re.findall(r"<input [^>]*>", page) if re.search(r'type="(datetime-local|time)"', tag)]
    for name in re.findall(r' name="([^"]*)"', " ".join(timed)):
        found[name] = re.sub(r"(:\d\d):00$", r"\1", found.get(name, ""))
    return {name: value.replace("\n", "\r\n") for name, value in found.items()}


class Tab:
    """A browser's tab with one form, as it was when it was opened."""

    def __init__(self, browser: TestClient, page: str, action: str) -> None:
        self.browser, self.action = browser, action
        self.fields = fields_of(browser.get(page).text, action)

    def send(self, **typed: str):  # type: ignore[no-untyped-def]
        return self.browser.post(self.action, data=self.fields | typed)


@pytest.fixture
def qoc_tab(browser: TestClient, client: TestClient, session_id: int) -> Callable[[], Tab]:
    assert client.put(f"/api/v1/sessions/{session_id}/qoc", json=STORED).status_code == 200
    return lambda: Tab(browser, f"/sessions/{session_id}", f"/sessions/{session_id}/qoc")


@pytest.fixture
def settings_tab(browser: TestClient, participant_code: str) -> Callable[[], Tab]:
    return lambda: Tab(browser, f"/participants/{participant_code}/settings", f"/participants/{participant_code}/settings")


def stored_qoc(client: TestClient, session_id: int) -> tuple[object, ...]:
    qoc = client.get(f"/api/v1/sessions/{session_id}/qoc").json()
    return qoc["grasp_hz"], qoc["rating"], qoc["tremor_percent"], qoc["revision"]


def settings_of(client: TestClient) -> dict[str, object]:
    return dict(client.get("/api/v1/participants/P1").json()["settings"])


def test_an_old_form_leaves_qocs_alone_that_another_tab_changed(client: TestClient, session_id: int, qoc_tab: Callable[[], Tab]) -> None:
    first, second = qoc_tab(), qoc_tab()
    assert first.send(rating="9").status_code == 303
    assert second.send(grasp_hz="3").status_code == 303
    assert stored_qoc(client, session_id) == (3.0, 9, 10.0, 3)


def test_an_old_form_opened_before_the_first_entry_leaves_that_entry_alone(
    browser: TestClient, client: TestClient, session_id: int
) -> None:
    old = Tab(browser, f"/sessions/{session_id}", f"/sessions/{session_id}/qoc")
    assert old.send(rating="9").status_code == 303
    assert old.send(grasp_hz="3").status_code == 303
    assert stored_qoc(client, session_id) == (3.0, 9, None, 2)


def test_two_values_for_one_qoc_are_a_conflict_that_keeps_what_was_typed(
    client: TestClient, session_id: int, qoc_tab: Callable[[], Tab], browser: TestClient
) -> None:
    first, second = qoc_tab(), qoc_tab()
    assert first.send(rating="9", tremor_percent="20").status_code == 303
    assert client.put(f"/api/v1/sessions/{session_id}/qoc", json={"grasp_hz": 3.5}).status_code == 200
    refused = second.send(rating="7", reason="my <reason>")
    assert refused.status_code == 409
    text = unescape(refused.text)
    assert "Rating" in text
    assert "stored now: 9, by admin-page@clinic.example; you typed: 7" in text
    assert stored_qoc(client, session_id) == (3.5, 9, 20.0, 3)
    again = fields_of(refused.text, second.action)
    assert again == {"revision": "3", "grasp_hz": "3.5", "rating": "7", "tremor_percent": "20", "reason": "my <reason>"}
    assert browser.post(second.action, data=again).status_code == 303
    assert stored_qoc(client, session_id) == (3.5, 7, 20.0, 4)


def test_the_same_qoc_typed_twice_is_no_conflict(client: TestClient, session_id: int, qoc_tab: Callable[[], Tab]) -> None:
    first, second = qoc_tab(), qoc_tab()
    assert first.send(rating="9").status_code == 303
    assert second.send(rating="9").status_code == 303
    assert stored_qoc(client, session_id) == (STORED["grasp_hz"], 9, 10.0, 2)


@pytest.mark.parametrize("revision", ["", "77", "x"])
def test_a_form_of_a_revision_that_does_not_exist_changes_nothing(
    revision: str, client: TestClient, session_id: int, qoc_tab: Callable[[], Tab]
) -> None:
    assert qoc_tab().send(revision=revision, rating="9").status_code == 409
    assert stored_qoc(client, session_id)[3] == 1


def test_an_old_settings_form_leaves_alone_what_another_tab_changed(client: TestClient, settings_tab: Callable[[], Tab]) -> None:
    first, second = settings_tab(), settings_tab()
    assert first.send(gamma="0.9").status_code == 303
    assert second.send(c1="0.5").status_code == 303
    settings = settings_of(client)
    assert (settings["gamma"], settings["c1"], settings["version"]) == (0.9, 0.5, 3)


def test_two_values_for_one_setting_are_a_conflict_that_keeps_what_was_typed(
    client: TestClient, settings_tab: Callable[[], Tab], browser: TestClient
) -> None:
    first, second = settings_tab(), settings_tab()
    assert first.send(gamma="0.9", window="12").status_code == 303
    refused = second.send(gamma="0.8", reason="my <reason>")
    assert refused.status_code == 409
    assert "stored now: 0.9, by admin-page@clinic.example; you typed: 0.8" in unescape(refused.text)
    assert settings_of(client)["version"] == 2
    again = fields_of(refused.text, second.action)
    assert (again["version"], again["gamma"], again["window"], again["reason"]) == ("2", "0.8", "12", "my <reason>")
    assert browser.post(second.action, data=again).headers["location"].endswith("done=changed")
    settings = settings_of(client)
    assert (settings["gamma"], settings["window"], settings["version"], settings["reason"]) == (0.8, 12, 3, "my <reason>")


def test_settings_saved_untouched_make_no_version_and_keep_every_digit(
    client: TestClient, participant_code: str, settings_tab: Callable[[], Tab]
) -> None:
    change = {"settings": {"xi_beta": 1.23456789012, "beta_unit": "device units"}}
    assert client.put(f"/api/v1/participants/{participant_code}/settings", json=change).status_code == 200
    tab = settings_tab()
    assert tab.fields["xi_beta"] == "1.23456789"
    assert tab.send().headers["location"].endswith("done=same")
    assert settings_of(client)["version"] == 2
    assert tab.send(gamma="0.9").headers["location"].endswith("done=changed")
    settings = settings_of(client)
    assert (settings["xi_beta"], settings["beta_unit"], settings["gamma"]) == (1.23456789012, "device units", 0.9)


def test_a_suggested_threshold_does_not_replace_one_that_was_set_meanwhile(browser: TestClient, client: TestClient, table: bytes) -> None:
    client.post("/api/v1/participants", json={"code": "P2", "settings": {"cdbs_amplitude_ma": 3.0}})
    client.post("/api/v1/participants/P2/visits", json={"number": 1})
    upload = {"participant": "P2", "visit": "1", "controller": "cdbs", "beta_unit": "uV", "beta_source": "table"}
    assert client.post("/api/v1/uploads", data=upload, files={"file": ("a.csv", table)}).status_code == 201
    page = browser.get("/participants/P2/settings").text
    button = page[: page.index("<button>Use ")]
    fields = fields_of(button + "</form>", "/participants/P2/settings")
    assert set(fields) == {"version", "xi_beta", "beta_unit", "beta_source", "reason"}
    assert client.put("/api/v1/participants/P2/settings", json={"settings": {"xi_beta": 9.0}}).status_code == 200
    assert browser.post("/participants/P2/settings", data=fields).status_code == 409
    assert client.get("/api/v1/participants/P2").json()["settings"]["xi_beta"] == 9.0


@pytest.fixture
def everything_typed(client: TestClient, session_id: int, participant_code: str) -> str:
    """A session, its visit and a proposal with a value in every field whose text a browser changes; the proposal's number."""
    assert client.put(f"/api/v1/sessions/{session_id}/qoc", json=STORED).status_code == 200
    visit = client.get(f"/api/v1/sessions/{session_id}").json()["visit_id"]
    noted = {"note": "first line\nsecond line", "reason": "as told"}
    assert client.patch(f"/api/v1/visits/{visit}", json=noted).status_code == 200
    files = [("file", ("s.zip", device_zip(("random",), steps=60)))]
    sent = client.post("/api/v1/uploads", data={"participant": participant_code}, files=files)
    assert sent.status_code == 201, sent.text
    return str(sent.json()["proposals"][0]["session"]["id"])


FORMS = {
    "proposals": ("/participants/P1/proposals", "/participants/P1/proposals", {"do": "save:all"}),
    "settings": ("/participants/P1/settings", "/participants/P1/settings", {}),
    "margins": ("/participants/P1/margins", "/participants/P1/margins", {}),
    "visit": ("/visits/{visit}", "/visits/{visit}", {"reason": "looked again"}),
    "outcomes": ("/sessions/{session}", "/sessions/{session}/qoc", {}),
    "correction": ("/sessions/{session}", "/sessions/{session}/correction", {"reason": "looked again"}),
    "conditions": ("/sessions/{session}", "/sessions/{session}/conditions", {"conditions_reason": "looked again"}),
}
"""Every form that compares what was typed with what it showed: its page, its address, and what must be typed to send it."""


@pytest.mark.parametrize("form", FORMS)
def test_a_form_that_nobody_touched_changes_nothing_however_a_browser_writes_its_values(
    form: str, browser: TestClient, client: TestClient, session_id: int, everything_typed: str, db: Session
) -> None:
    visit = client.get(f"/api/v1/sessions/{session_id}").json()["visit_id"]
    page, action, more = FORMS[form]
    page, action = (path.format(visit=visit, session=session_id) for path in (page, action))
    written = text("select count(*) from audit_event where action in ('insert', 'update', 'delete')")
    if form == "proposals":  # a time in full minutes, which browsers shorten
        first = as_browsers_send(browser.get(page).text, action) | {f"from-{everything_typed}": "2026-03-02T10:01"}
        assert browser.post(action, data=first | more).status_code == 303
    opened, before = browser.get(page).text, db.scalar(written)
    fields = as_browsers_send(opened, action)
    answers = [browser.post(action, data=fields | more) for _ in range(2)]  # a second time, as after going back
    db.rollback()
    assert db.scalar(written) == before, answers[0].text[:400]
    assert [a.status_code for a in answers] != [409, 409]
    assert "Another person changed" not in answers[1].text
    assert "after this form was opened" not in answers[1].text


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("2026-03-02T10:00", "2026-03-02T10:00:00", True), ("2026-03-02 10:00:00", "2026-03-02T10:00:00+00:00", True),
        ("10:00", "10:00:00", True), ("a\r\nb", "a\nb", True), ("2026-03-02T10:00", "2026-03-02T10:00:30", False),
        ("10:00", "10:01", False), ("1.5", "1.50", False), ("a: b", "a:b", False),
    ],
)  # fmt: skip
def test_times_are_compared_as_times_and_all_else_as_text(one: str, other: str, same: bool) -> None:
    assert same_value(one, other) is same_value(other, one) is same
