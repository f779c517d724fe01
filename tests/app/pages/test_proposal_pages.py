"""Pages of proposed sessions and of the quarantine: one form for a whole visit, nothing typed lost, no tab overwriting another."""

from __future__ import annotations

import re
from collections.abc import Callable
from html import unescape
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.app.ingest.conftest import device_zip, steady
from tests.app.pages.test_stale_forms import fields_of
from tests.app.words import flat

URL = "/participants/P1/proposals"


@pytest.fixture
def propose(client: TestClient, participant_code: str) -> Callable[..., list[int]]:
    """Upload files without a controller; numbers of the proposals."""

    def send(*files: tuple[str, bytes], **fields: str) -> list[int]:
        answer = client.post("/api/v1/uploads", data={"participant": participant_code, **fields}, files=[("file", f) for f in files])
        assert answer.status_code == 201, answer.text
        return [p["session"]["id"] for p in answer.json()["proposals"]]

    return send


def confirmed(client: TestClient) -> set[int]:
    return {s["id"] for s in client.get("/api/v1/visits/1/sessions").json()["items"]}


def press(browser: TestClient, do: str, fields: dict[str, str] | None = None, **typed: str) -> Any:
    """Open the form, type, press a button."""
    fields = fields_of(browser.get(URL).text, URL) if fields is None else fields
    return browser.post(URL, data=fields | {k.replace("_", "-"): v for k, v in typed.items()} | {"do": do})


def test_a_whole_visit_is_confirmed_in_one_go_and_what_is_open_stays(browser: TestClient, client: TestClient, propose: Any) -> None:
    off, on, half = propose(("a.csv", steady(0)), ("b.csv", steady(1)), ("c.csv", steady(0.5)), visit="1")
    page = unescape(browser.get(URL).text)
    assert "the amplitude is 0 in all 20 steps where it is known" in page
    pictures = re.findall(r'<div class="thumbnail">(<svg.*?</svg>)</div>', page, re.S)
    assert len(pictures) == 3, "each proposal is seen at a glance"
    for picture in pictures:
        assert "Beta (µV)" in picture
        assert "Amplitude (% of cDBS)" in picture or "Amplitude (mA)" in picture
        assert picture.count("<path") >= 2
    answer = press(browser, "confirm:all")
    assert answer.status_code == 303
    assert answer.headers["location"].endswith(f"confirmed={off},{on}")
    assert confirmed(client) == {off, on}
    after = browser.get(answer.headers["location"]).text
    assert "Confirmed." in after
    assert f"Proposed session {half}" in after


def test_a_row_per_file_tells_files_of_one_name_apart_and_one_visit_counts_for_all(
    browser: TestClient, client: TestClient, propose: Any
) -> None:
    numbers = propose(*[("rcs.csv", steady(level)) for level in (0, 1, 0.5, 0.4)])
    page = browser.get(URL).text
    rows = re.findall(r'<tr id="proposal-\d+">.*?</tr>', page, re.S)
    assert len(rows) == 4
    assert len({flat(re.findall(r"<small.*?</small>", row, re.S)[0]) for row in rows}) == 4, "each names its own file"
    assert all(f'name="{name}-{n}"' in row for n, row in zip(numbers, rows, strict=True) for name in ("visit", "controller"))
    answer = press(browser, "confirm:all", visit_all="1")
    assert answer.status_code == 303
    assert confirmed(client) == set(numbers[:2]), "those whose controller is open wait"
    fields = fields_of(browser.get(URL).text, URL)
    assert [fields[f"visit-{n}"] for n in numbers[2:]] == ["1", "1"], "their visit is kept"


def test_confirming_one_saves_what_was_typed_into_the_others(browser: TestClient, client: TestClient, propose: Any) -> None:
    first, second = propose(("a.csv", steady(1)), ("b.csv", steady(0.5)), visit="1")
    assert press(browser, f"confirm:{first}", **{f"controller_{second}": "random", f"to_{second}": "0:20"}).status_code == 303
    assert confirmed(client) == {first}
    kept = client.get(f"/api/v1/proposals/{second}").json()
    assert (kept["session"]["controller"], kept["session"]["duration_s"], kept["version"]) == ("random", 20, 2)


def test_a_form_of_an_older_version_is_refused_with_what_was_typed(browser: TestClient, client: TestClient, propose: Any) -> None:
    (number,) = propose(("a.csv", steady(0.5)), visit="1")
    old = fields_of(browser.get(URL).text, URL)
    assert press(browser, "save:all", **{f"controller_{number}": "random"}).status_code == 303
    refused = press(browser, f"confirm:{number}", old, **{f"controller_{number}": "cdbs"})
    assert refused.status_code == 409
    assert "was changed by admin-page@clinic.example" in unescape(refused.text)
    assert confirmed(client) == set()
    again = fields_of(refused.text, URL)
    assert (again[f"controller-{number}"], again[f"version-{number}"]) == ("cdbs", "2")
    assert press(browser, f"confirm:{number}", again).status_code == 303
    assert client.get(f"/api/v1/sessions/{number}").json()["controller"] == "cdbs"


def test_a_correction_saved_from_an_old_form_is_refused_and_kept_and_the_others_stand(
    browser: TestClient, client: TestClient, propose: Any
) -> None:
    first, second = propose(("a.csv", steady(0.5)), ("b.csv", steady(0.4)), visit="1")
    old = fields_of(browser.get(URL).text, URL)
    press(browser, "save:all", **{f"controller_{second}": "random", f"hemisphere_{second}": "left"})
    refused = press(browser, "save:all", old, **{f"controller_{second}": "cdbs", f"controller_{first}": "other"})
    assert refused.status_code == 409
    assert "was changed by admin-page@clinic.example" in unescape(refused.text)
    stored = {i: client.get(f"/api/v1/proposals/{i}").json()["session"]["controller"] for i in (first, second)}
    assert stored == {first: "other", second: "random"}
    again = fields_of(refused.text, URL)
    # what was typed is in the form, next to what the other tab had saved
    assert (again[f"controller-{second}"], again[f"hemisphere-{second}"]) == ("cdbs", "left")
    assert press(browser, "save:all", again).status_code == 303
    session = client.get(f"/api/v1/proposals/{second}").json()["session"]
    assert (session["controller"], session["hemisphere"]) == ("cdbs", "left")


def test_an_old_form_without_a_correction_of_its_own_refuses_nothing(browser: TestClient, client: TestClient, propose: Any) -> None:
    first, second = propose(("a.csv", steady(0.5)), ("b.csv", steady(0.4)), visit="1")
    old = fields_of(browser.get(URL).text, URL)
    press(browser, "save:all", **{f"controller_{second}": "random"})
    assert press(browser, "save:all", old, **{f"controller_{first}": "other"}).status_code == 303
    stored = [client.get(f"/api/v1/proposals/{i}").json()["session"]["controller"] for i in (first, second)]
    assert stored == ["other", "random"]


def test_an_old_form_does_not_take_back_what_another_tab_saved(browser: TestClient, client: TestClient, propose: Any) -> None:
    first, second = propose(("a.csv", steady(1)), ("b.csv", steady(0.5)), visit="1")
    old = fields_of(browser.get(URL).text, URL)
    press(browser, "save:all", **{f"controller_{second}": "random"})
    assert press(browser, f"confirm:{first}", old).status_code == 303
    assert client.get(f"/api/v1/proposals/{second}").json()["session"]["controller"] == "random"


def test_a_proposal_that_is_gone_is_said_to_be_gone(browser: TestClient, propose: Any) -> None:
    (number,) = propose(("a.csv", steady(1)), visit="1")
    old = fields_of(browser.get(URL).text, URL)
    assert press(browser, f"confirm:{number}", old).status_code == 303
    late = press(browser, f"discard:{number}", old, **{f"reason_{number}": "no"})
    assert late.status_code == 422
    assert f"Session {number} is no proposal any more" in late.text


def test_a_recording_is_cut_by_the_clock_on_the_page(browser: TestClient, client: TestClient, propose: Any) -> None:
    (number,) = propose(("s.zip", device_zip(("cdbs", "no_dbs"), steps=40, gap_s=30)))
    parts = {
        f"part-{number}-0-from": "2026-03-02T10:00:30", f"part-{number}-0-to": "2026-03-02T10:01:30", f"part-{number}-0-controller": "cdbs",
        f"part-{number}-2-from": "2026-03-02T10:02:40", f"part-{number}-2-to": "2026-03-02T10:03:40",
    }  # fmt: skip
    fields = fields_of(browser.get(URL).text, URL)
    bad = press(browser, f"split:{number}", fields | parts | {f"part-{number}-2-to": "soon"})
    assert bad.status_code == 422
    assert "'soon' is no date and time" in unescape(bad.text)
    assert 'value="2026-03-02T10:01:30"' in bad.text
    assert press(browser, f"split:{number}", fields | parts).status_code == 303
    made = client.get("/api/v1/participants/P1/proposals").json()
    assert [p["session"]["duration_s"] for p in made] == [60, 60]
    assert made[0]["session"]["controller"] == "cdbs"
    page = unescape(browser.get(URL).text)
    assert f"cut out of proposed session {number}" in page


@pytest.mark.parametrize(
    ("typed", "named"),
    [
        ({"from": "soon"}, "'soon' is no time"),
        ({"to": "-1:00"}, "does not lie in the recording"),
        ({"from": "0:30", "to": "0:10"}, "holds no step"),
        ({"policy": "ghost"}, "no policy 'ghost'"),
        ({"controller": ""}, "its controller is open"),
    ],
)
def test_what_cannot_be_is_said_at_the_proposal_and_stays_typed(
    browser: TestClient, client: TestClient, propose: Any, typed: dict[str, str], named: str
) -> None:
    (number,) = propose(("a.csv", steady(1)), visit="1")
    refused = press(browser, f"confirm:{number}", **{f"{k}_{number}": v for k, v in typed.items()})
    assert refused.status_code == 422
    assert named in unescape(refused.text)
    again = fields_of(refused.text, URL)
    assert {k: again[f"{k}-{number}"] for k in typed} == typed
    assert confirmed(client) == set()


def test_one_button_adds_the_visit_of_a_recording_and_keeps_what_was_typed(browser: TestClient, client: TestClient, propose: Any) -> None:
    (number,) = propose(("a.zip", device_zip(("random",), minute=26 * 60)))
    assert "Create visit 2026-03-03 from the recording" in flat(browser.get(URL).text)
    done = press(browser, f"visit:{number}", **{f"controller_{number}": "random"})
    assert done.headers["location"].endswith("?done=visit")
    page = browser.get(done.headers["location"]).text
    assert "Visit added" in page
    assert "Create visit" not in page
    kept = client.get(f"/api/v1/proposals/{number}").json()
    assert (kept["session"]["visit"], kept["session"]["controller"], kept["visit_open"]) == (2, "random", False)
    assert press(browser, f"visit:{number}").status_code == 422


def test_the_page_of_one_proposal_shows_its_traces_and_a_session_link_leads_there(browser: TestClient, propose: Any) -> None:
    (number,) = propose(("s.zip", device_zip(("cdbs",))))
    moved = browser.get(f"/sessions/{number}")
    assert (moved.status_code, moved.headers["location"]) == (303, f"/proposals/{number}")
    page = browser.get(f"/proposals/{number}").text
    assert "data-chart" in page
    assert f"Confirm session {number}" in flat(page)
    press(browser, f"confirm:{number}", **{f"controller_{number}": "cdbs"})
    assert browser.get(f"/proposals/{number}").headers["location"] == f"/sessions/{number}"


def test_a_viewer_sees_proposals_without_buttons(sign_in: Callable[[str], TestClient], propose: Any) -> None:
    propose(("a.csv", steady(1)), visit="1")
    viewer = sign_in("viewer")
    page = viewer.get(URL)
    assert page.status_code == 200
    assert "Confirm session" not in page.text
    assert viewer.post(URL, data={"do": "confirm:all"}).status_code == 403


def test_a_waiting_grasp_file_is_attached_on_the_page(browser: TestClient, client: TestClient, propose: Any) -> None:
    propose(("g.csv", b"t_s\n0\n0.5\n1\n1.5\n"))
    (number,) = propose(("a.csv", steady(1)), visit="1")
    page = browser.get(URL).text
    action = "/uploaded-files/1/session"
    assert f'action="{action}"' in page
    assert browser.post(action, data={"session_id": ""}).status_code == 422
    assert browser.post(action, data={"session_id": str(number)}).status_code == 303
    assert f'action="{action}"' not in browser.get(URL).text


def test_several_files_on_the_upload_page_are_one_upload_whose_proposals_are_offered(
    browser: TestClient, client: TestClient, participant_code: str
) -> None:
    files = [("file", ("right.zip", device_zip(("random",), "P1"))), ("file", ("left.zip", device_zip(("random",), "P2", minute=0.2)))]
    page = browser.post(f"/participants/{participant_code}/upload", data={}, files=files)
    assert page.status_code == 200
    assert "1 to confirm" in page.text
    (proposal,) = client.get("/api/v1/participants/P1/proposals").json()
    assert len(proposal["parts"]) == 2
    assert "1 to confirm" in browser.get("/uploads/1").text


def test_the_quarantine_page_reviews_and_decides(browser: TestClient, client: TestClient, participant_code: str) -> None:
    secret = b"\0\1 Jane Example" * 40
    client.post("/api/v1/uploads", data={"participant": participant_code}, files=[("file", ("x.bin", secret))])
    url, action = f"/participants/{participant_code}/quarantine", "/uploaded-files/1/decision"
    assert "no format this service reads" in browser.get(url).text
    assert "Release as it is" not in browser.get(url).text.split('<p class="muted">')[0]
    without = browser.post(action, data={"do": "discard", "reason": " "})
    assert without.status_code == 422
    assert "needs a reason" in without.text
    assert browser.post(action, data={"do": "review"}).content == secret
    assert 'value="as_is"' in browser.get(url).text
    assert browser.post(action, data={"do": "discard", "reason": "a picture"}).status_code == 303
    page = browser.get(url).text
    assert "Nothing in quarantine" in page
    assert "a picture" in page
    assert browser.post(action, data={"do": "discard", "reason": "again"}).status_code == 409
