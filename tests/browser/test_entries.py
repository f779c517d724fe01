"""Typed and unsaved text: back after a reload and an expired sign-in, gone once saved, never shown to another person."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from playwright.sync_api import expect

from app.accounts import service as accounts
from app.platform.database import transaction
from app.tables.accounts import Role
from tests.browser.conftest import PASSWORD, Watched

pytestmark = pytest.mark.browser

BACK = "main .note.kept"
KEPT = "() => sessionStorage.getItem('betaloop-entries')"
SAVE = "#qocs form button.primary"
OTHER = "second@clinic.example"


@pytest.fixture
def tab(window: Callable[..., Watched], study_world: list[int]) -> Watched:
    """A tab in which the administrator has signed in."""
    watched = window()
    watched.signed_in()
    return watched


def session_of(client: TestClient) -> str:
    """Return the page of a session that has no QoCs yet."""
    rows = "\n".join(["t_s,beta,amplitude_fraction", *(f"{2 * i},{1 + i % 4},0.5" for i in range(-9, 41))])
    data = {"participant": "P1", "visit": "1", "controller": "cdbs"}
    answer = client.post("/api/v1/uploads", data=data, files={"file": ("new.csv", rows.encode())})
    return f"/sessions/{answer.json()['sessions'][0]['id']}"


def test_entries_come_back_by_form_and_record_until_they_are_saved(tab: Watched, study_world: list[int], client: TestClient) -> None:
    page, path = tab.page, session_of(client)
    tab.open(path)
    page.fill("[name=grasp_hz]", "2.4")
    page.fill("[name=rating]", "7")
    page.reload()
    expect(page.locator(BACK)).to_contain_text("is not saved yet")
    assert (page.input_value("[name=grasp_hz]"), page.input_value("[name=rating]")) == ("2.4", "7")
    tab.open(f"/sessions/{study_world[1]}")
    assert page.input_value("[name=grasp_hz]") == "3"
    assert page.locator(BACK).count() == 0
    tab.open(path)
    assert page.input_value("[name=grasp_hz]") == "2.4"
    page.click(SAVE)
    page.wait_for_selector("main .note.good")
    assert page.evaluate(KEPT) is None
    page.reload()
    assert page.locator(BACK).count() == 0
    assert client.get(f"/api/v1{path}/qoc").json()["grasp_hz"] == 2.4
    assert tab.errors == []


def test_another_person_in_the_same_tab_is_shown_nothing(tab: Watched, client: TestClient) -> None:
    with transaction("test") as db:
        accounts.add_user(db, OTHER, Role.CLINICIAN, PASSWORD)
    page, path = tab.page, session_of(client)
    tab.open(path)
    page.fill("[name=grasp_hz]", "2.4")
    page.context.clear_cookies()  # the first person's sign-in ended by itself
    tab.sign_in(OTHER)
    tab.open(path)
    assert page.input_value("[name=grasp_hz]") == ""
    assert page.evaluate(KEPT) is None
    page.context.clear_cookies()
    tab.sign_in()
    tab.open(path)
    assert page.input_value("[name=grasp_hz]") == ""


def test_what_one_person_entered_is_never_saved_under_anothers_name(tab: Watched, client: TestClient) -> None:
    with transaction("test") as db:
        accounts.add_user(db, OTHER, Role.CLINICIAN, PASSWORD)
    page, path = tab.page, session_of(client)
    tab.open(path)
    page.fill("[name=grasp_hz]", "2.4")
    cookies = page.context.cookies()
    page.context.clear_cookies()
    second = page.context.new_page()
    Watched(second, tab.address).sign_in(OTHER)  # another person, in another tab of the same browser
    page.click(SAVE)
    page.wait_for_selector("h1:text('Entered by somebody else')")
    assert "2.4" not in client.get(f"/api/v1{path}/qoc").text
    page.wait_for_function(f"{KEPT[6:]} === null")  # its scripts run after its heading is there
    page.context.clear_cookies()
    page.context.add_cookies(cookies)
    tab.open(path)
    page.fill("[name=grasp_hz]", "2.4")
    page.context.clear_cookies()
    page.click(SAVE)
    page.wait_for_selector("h1:text('Your sign-in has expired')")
    Watched(second, tab.address).sign_in(OTHER)
    page.click("text=Send it again")
    page.wait_for_selector("h1:text('Entered by somebody else')")
    assert "2.4" not in client.get(f"/api/v1{path}/qoc").text


def test_signing_out_forgets_and_an_expired_sign_in_does_not(tab: Watched, client: TestClient) -> None:
    page, path = tab.page, session_of(client)
    tab.open(path)
    page.fill("[name=grasp_hz]", "2.4")
    page.context.clear_cookies()
    page.click(SAVE)
    page.wait_for_selector("h1:text('Your sign-in has expired')")
    tab.sign_in()
    tab.open(path)
    assert page.input_value("[name=grasp_hz]") == "2.4"
    page.click("text=Sign out")
    page.wait_for_selector("h1:text('Sign in')")
    tab.sign_in()
    tab.open(path)
    assert page.input_value("[name=grasp_hz]") == ""


def test_what_is_sent_again_after_signing_in_is_kept_no_longer(tab: Watched, client: TestClient) -> None:
    page, path = tab.page, session_of(client)
    tab.open(path)
    page.fill("[name=grasp_hz]", "2.4")
    cookies = page.context.cookies()
    page.context.clear_cookies()
    page.click(SAVE)
    page.wait_for_selector("h1:text('Your sign-in has expired')")
    page.context.add_cookies(cookies)  # signed in again in another window
    page.click("text=Send it again")
    page.wait_for_selector("main .note.good")
    assert page.evaluate(KEPT) is None
    assert client.get(f"/api/v1{path}/qoc").json()["grasp_hz"] == 2.4


def test_what_was_stopped_on_its_way_is_kept_whatever_is_opened_next(tab: Watched, client: TestClient) -> None:
    page, path = tab.page, session_of(client)
    tab.open(path)
    page.fill("[name=grasp_hz]", "2.4")
    page.route("**/qoc?*", lambda route: route.abort("aborted"))
    with page.expect_event("requestfailed"):
        page.eval_on_selector(SAVE, "button => { setTimeout(() => button.click(), 0); }")  # a click of the test's would wait for an answer
    page.eval_on_selector(".crumbs a[href^='/visits/']", "link => { setTimeout(() => link.click(), 0); }")
    page.wait_for_url("**/visits/*")
    tab.open(path)
    assert page.input_value("[name=grasp_hz]") == "2.4"
    expect(page.locator(BACK)).to_contain_text("is not saved yet")


def test_what_a_colleague_saved_meanwhile_stands_and_the_entry_is_told(tab: Watched, client: TestClient) -> None:
    page, path = tab.page, session_of(client)
    tab.open(path)
    page.fill("[name=grasp_hz]", "2.4")
    page.fill("[name=rating]", "7")
    client.put(f"/api/v1{path}/qoc", json={"grasp_hz": 2.1})
    page.reload()
    assert page.input_value("[name=grasp_hz]").startswith("2.1")
    assert page.input_value("[name=rating]") == "7"
    expect(page.locator(BACK)).to_contain_text("Grasp frequency: you had typed 2.4; 2.1")
    page.click(f"{BACK} button")
    assert page.input_value("[name=rating]") == ""
    page.reload()
    assert page.locator(BACK).count() == 0


def test_a_refused_form_is_kept_and_no_secret_ever_is(tab: Watched) -> None:
    page = tab.page
    tab.open("/participants/P1/visits/new")
    page.fill("[name=number]", "1")  # there is a visit 1
    page.click("main form[method=post] button.primary")
    page.wait_for_selector("main .note.bad")
    tab.open("/participants/P1/visits/new")
    assert page.input_value("[name=number]") == "1"
    tab.open("/accounts")
    page.fill("main [name=email]", "new@clinic.example")
    page.fill("#f-new-password", "a first password")
    kept: dict[str, Any] = json.loads(page.evaluate(KEPT))
    assert "new@clinic.example" in json.dumps(kept)
    assert "a first password" not in json.dumps(kept)
    page.reload()
    assert (page.input_value("main [name=email]"), page.input_value("#f-new-password")) == ("new@clinic.example", "")


def test_what_stood_beside_something_too_large_stands_in_the_form_again(tab: Watched) -> None:
    page = tab.page
    tab.open("/participants/P1/visits/new")
    page.fill("[name=number]", "7")
    page.fill("[name=cdbs_left]", "2.5")
    page.eval_on_selector("[name=note]", "note => { note.removeAttribute('maxlength'); note.value = 'x'.repeat(2 << 20); }")
    page.click("main form[method=post] button.primary")
    page.wait_for_selector("h1:text('Too large to take')")
    assert "The other entries are in the form that you came from" in page.inner_text("main")
    page.go_back()
    page.wait_for_selector("[name=number]")
    assert (page.input_value("[name=number]"), page.input_value("[name=cdbs_left]")) == ("7", "2.5")
    tab.open("/participants/P1/visits/new")  # also where the form is opened again
    assert (page.input_value("[name=number]"), page.input_value("[name=cdbs_left]")) == ("7", "2.5")
