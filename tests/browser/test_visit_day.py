"""The clinic day on a tablet: real Chromium, with the network cut, the browser killed and the sign-in ended in the middle."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect
from pydantic import TypeAdapter
from sqlalchemy import text

from app.accounts import service as accounts
from app.planning.visit_day.record import DeviceTime
from app.platform.database import transaction
from app.tables.accounts import Role
from tests.browser.conftest import FLAGS, PASSWORD, Watched, kill_browser, program
from tests.browser.day_page import KEPT, fill, once_drawn, open_day, stored, tap, wait_for, wait_until_stored, worker_ready
from tests.clinic_day import ClinicDay, clinic_day

__all__ = ["clinic_day"]
pytestmark = pytest.mark.browser

SCREENS = ((768, 1024), (1024, 768), (1280, 900))


def test_a_cut_network_and_a_reload_without_it_lose_nothing(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    watched = window(768, 1024)
    watched.signed_in()
    open_day(watched, clinic_day)
    worker_ready(watched)
    tap(watched, "start")
    wait_until_stored(watched, clinic_day, 1)
    wait_for(watched, 0)
    watched.page.context.set_offline(True)
    tap(watched, "rating-7")
    tap(watched, "speech-mild")
    wait_for(watched, 2, "offline")
    watched.page.reload()
    watched.page.wait_for_selector("#day[data-ready=yes]")
    watched.page.wait_for_selector("section.day-session[data-state=running]")
    watched.page.wait_for_selector("[data-act='rating-7'][aria-pressed=true]")
    tap(watched, "stop")
    wait_for(watched, 3, "offline")
    assert stored(clinic_day) == ["start"]
    watched.page.context.set_offline(False)
    wait_for(watched, 0)
    assert stored(clinic_day) == ["start", "rating", "speech", "stop"]
    assert watched.page.evaluate(KEPT)["entries"] == []
    assert watched.foreign == []


def test_a_dose_takes_two_taps_without_network_too(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    day = datetime.now(UTC).date().isoformat()
    assert clinic_day.client.patch(f"/api/v1/visits/{clinic_day.visit}", json={"date": day, "reason": "moved"}).status_code == 200
    schedule = {"medication": [{"drug": "pramipexole", "mg": 0.25, "at": "08:00"}]}
    body = {"version": 0, "characteristics": schedule, "reason": "asked"}
    assert clinic_day.client.put("/api/v1/participants/P1/characteristics", json=body).status_code == 200
    watched = window(768, 1024)
    watched.signed_in()
    open_day(watched, clinic_day)
    watched.page.context.set_offline(True)
    tap(watched, "dose")
    assert once_drawn(watched) == []
    tap(watched, "dose-levodopa-100")
    wait_for(watched, 1, "offline")
    tap(watched, "dose")
    tap(watched, "ago-30")
    tap(watched, "dose-pramipexole-0.25")  # of the participant's own schedule
    wait_for(watched, 2, "offline")
    expect(watched.page.locator("[data-doses='2']")).to_contain_text("Pramipexole")
    watched.page.context.set_offline(False)
    wait_for(watched, 0)
    stored_doses = clinic_day.client.get(f"/api/v1/visits/{clinic_day.visit}/doses").json()
    assert [(d["drug"], d["mg"]) for d in stored_doses] == [("pramipexole", 0.25), ("levodopa", 100)]
    first, second = (datetime.fromisoformat(d["taken_at"]) for d in stored_doses)
    assert 29 <= (second - first).total_seconds() / 60 <= 31
    watched.page.reload()
    expect(watched.page.locator("[data-doses='2']")).to_be_visible()
    assert watched.errors == [e for e in watched.errors if "ERR_INTERNET_DISCONNECTED" in e]


def test_a_killed_browser_sends_what_it_held_when_it_comes_back(chromium: Any, address: str, clinic_day: ClinicDay, tmp_path: Path) -> None:
    profile = str(tmp_path / "profile")
    context = chromium.browser_type.launch_persistent_context(profile, executable_path=program(), args=FLAGS)
    watched = Watched(context.new_page(), address)
    watched.signed_in()
    open_day(watched, clinic_day)
    worker_ready(watched)
    context.set_offline(True)
    tap(watched, "start")
    tap(watched, "rating-9")
    wait_for(watched, 2, "offline")
    kill_browser(profile)
    context = chromium.browser_type.launch_persistent_context(profile, executable_path=program(), args=FLAGS)
    context.clear_cookies()  # a browser writes them down half a minute late: the signed-in user may have to do it again
    watched = Watched(context.new_page(), address)
    watched.open(f"/visit-day/{clinic_day.visit}")
    fill(watched, "admin@clinic.example")
    watched.page.wait_for_selector("#day[data-ready=yes]")
    wait_for(watched, 0)
    assert stored(clinic_day) == ["start", "rating"]
    watched.page.wait_for_selector("[data-act='rating-9'][aria-pressed=true]")
    context.close()


def test_what_waits_is_encrypted_and_gone_once_acknowledged(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    watched = window(768, 1024)
    watched.signed_in()
    open_day(watched, clinic_day)
    watched.page.context.set_offline(True)
    tap(watched, "start")
    tap(watched, "rating-7")
    wait_for(watched, 2, "offline")
    kept = watched.page.evaluate(KEPT)
    assert kept["keys"] == ["InvalidAccessError"]  # the key exists, and no script can read it out
    assert len(kept["entries"]) == 2
    assert not any(word in row for row in kept["entries"] + kept["days"] for word in ("rating", "start", "value", "cDBS", "P1"))
    watched.page.context.set_offline(False)
    wait_for(watched, 0)
    assert watched.page.evaluate(KEPT)["entries"] == []
    watched.page.click("text=Sign out")
    watched.page.wait_for_selector("[name=password]")
    watched.page.wait_for_function(f"async () => (await ({KEPT})()).keys.length === 0")


def test_an_expired_sign_in_loses_nothing_and_nobody_else_can_read_it(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    watched = window(768, 1024)
    watched.signed_in()
    open_day(watched, clinic_day)
    with transaction("test") as db:
        db.execute(text("update sign_in set ended_at = now()"))
        accounts.add_user(db, "ben@clinic.example", Role.CLINICIAN, PASSWORD)
    tap(watched, "start")
    tap(watched, "rating-3")
    wait_for(watched, 2, "signed-out")
    assert stored(clinic_day) == []
    watched.page.click("#day a.primary")
    fill(watched, "ben@clinic.example")
    watched.page.wait_for_selector("#day[data-ready=yes]")
    expect(watched.page.locator("#day")).to_contain_text("2 entries of somebody else wait")
    watched.page.wait_for_selector("section.day-session[data-state=waiting]")
    watched.page.click("text=Sign out")
    watched.page.wait_for_selector("[name=password]")
    watched.open(f"/sign-in?next=/visit-day/{clinic_day.visit}")
    fill(watched, "admin@clinic.example")
    watched.page.wait_for_selector("#day[data-ready=yes]")
    wait_for(watched, 0)
    listed = clinic_day.client.get(f"/api/v1/visits/{clinic_day.visit}/day/entries").json()["items"]
    assert [(e["kind"], e["entered_by"]) for e in listed] == [("start", "admin@clinic.example"), ("rating", "admin@clinic.example")]


@pytest.mark.slow
def test_two_tablets_that_say_different_things_ask_which_one_counts(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    one, other = window(768, 1024), window(768, 1024)
    for watched in (one, other):
        watched.signed_in()
        open_day(watched, clinic_day)
    tap(one, "start")
    wait_for(one, 0)
    other.page.reload()
    other.page.wait_for_selector("section[data-state=running]")
    one.page.context.set_offline(True)
    tap(one, "rating-7")
    tap(other, "rating-4")
    wait_for(other, 0)
    one.page.context.set_offline(False)
    one.page.wait_for_selector("text=Session 1 has different ratings")
    one.page.click("[data-act=choose] >> text=4,")
    wait_for(one, 0)
    expect(one.page.locator("#day")).not_to_contain_text("different ratings")
    other.page.reload()
    other.page.wait_for_selector("[data-act='rating-4'][aria-pressed=true]")
    expect(other.page.locator("#day")).not_to_contain_text("different ratings")


def test_a_severe_side_effect_tells_to_return_to_clinical_settings(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    watched = window(768, 1024)
    watched.signed_in()
    open_day(watched, clinic_day)
    tap(watched, "start")
    tap(watched, "dyskinesia-severe")
    box = watched.page.locator(".day-stop-rule")
    expect(box).to_contain_text("Return to clinical settings now")
    expect(box).to_be_in_viewport(ratio=1)
    expect(watched.page.locator("[data-act=severe-back]")).to_be_disabled()
    tap(watched, "severe-stop")
    tap(watched, "rating-2")
    tap(watched, "finish")
    expect(watched.page.locator("[data-act=start]")).to_be_disabled()
    watched.page.reload()
    watched.page.wait_for_selector(".day-stop-rule")
    tap(watched, "severe-back")
    watched.page.wait_for_selector(".day-stop-rule", state="detached")
    expect(watched.page.locator("[data-act=start]")).to_be_enabled()
    wait_for(watched, 0)
    assert stored(clinic_day) == ["start", "dyskinesia", "stop", "stop_cause", "rating", "session_end", "clinical_settings"]


def test_a_tap_is_not_lost_when_something_arrives_under_the_finger(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    watched = window(768, 1024)
    watched.signed_in()
    open_day(watched, clinic_day)
    tap(watched, "start")
    wait_until_stored(watched, clinic_day, 1)
    wait_for(watched, 0)
    watched.page.locator("[data-act=stop]").hover()  # waits until the page is drawn, also when it is drawn again meanwhile
    watched.page.mouse.down()
    watched.page.evaluate("() => { dispatchEvent(new Event('online')); }")  # draws the page again
    watched.page.wait_for_timeout(1500)
    assert stored(clinic_day) == ["start"], "the tap is not over yet"
    watched.page.mouse.up()
    watched.page.wait_for_selector("section[data-state=asked]")
    wait_for(watched, 0)
    assert stored(clinic_day) == ["start", "stop"]


def test_grasps_are_counted_for_ten_seconds(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    watched = window(768, 1024)
    clock = watched.page.clock
    clock.install()
    watched.signed_in()
    open_day(watched, clinic_day)
    tap(watched, "start")
    tap(watched, "count")
    clock.pause_at(datetime.fromtimestamp(watched.page.evaluate("() => Date.now()") / 1000 + 60, UTC))  # from here on only we move it
    for _ in range(9):
        watched.page.dispatch_event("[data-act=tap]", "pointerdown")
        clock.run_for(400)
    clock.run_for(10_000 - 9 * 400)
    clock.resume()
    watched.page.click(".day-dialog >> [data-act=keep]")
    watched.page.wait_for_selector("[data-value=grasp]:has-text('Hz')")
    wait_for(watched, 0)
    entry = clinic_day.client.get(f"/api/v1/visits/{clinic_day.visit}/day/entries").json()["items"][-1]["payload"]
    assert len(entry["taps_s"]) == 9
    assert entry["taps_s"][0] == 0
    moment = TypeAdapter(DeviceTime).validate_python
    assert 10 <= (moment(entry["ended_at"]) - moment(entry["began_at"])).total_seconds() < 11
    shown = watched.page.inner_text("[data-value=grasp]")
    assert shown == f"{8 / (entry['taps_s'][-1] - entry['taps_s'][0]):.2f} Hz, 9 open fists"


def test_a_note_is_screened_before_it_is_kept(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    watched = window(768, 1024)
    watched.signed_in()
    open_day(watched, clinic_day)
    tap(watched, "start")
    tap(watched, "note")
    watched.page.fill(".day-dialog textarea", "Mr Smith felt dizzy since 3/4/2026")
    tap(watched, "keep")
    expect(watched.page.locator(".day-dialog")).to_contain_text("Take this out first: a date (3/4/2026)")
    watched.page.fill(".day-dialog textarea", "Felt dizzy after Madopar")
    tap(watched, "keep")
    expect(watched.page.locator(".day-dialog")).to_contain_text("Is this a name? Madopar")
    tap(watched, "no-names")
    watched.page.wait_for_selector(".day-notes")
    wait_for(watched, 0)
    expect(watched.page.locator(".day-notes")).to_contain_text("Felt dizzy after Madopar")
    assert stored(clinic_day) == ["start", "note"]


def test_it_can_be_touched_and_read_on_every_screen(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    for scheme, acts in (("light", ("start", "stop", "speech-severe")), ("dark", ())):
        watched = window(*SCREENS[0], scheme)
        watched.signed_in()
        open_day(watched, clinic_day)
        for act in ("", *acts, "note", "count", "type"):
            if act:
                for width, height in SCREENS:
                    watched.page.set_viewport_size({"width": width, "height": height})
                    watched.page.click(f"[data-act='{act}']", trial=True)  # it could be touched there
                tap(watched, act)
            for width, height in SCREENS:
                watched.page.set_viewport_size({"width": width, "height": height})
                assert once_drawn(watched) == [], (width, height, scheme, act)
            if act in ("note", "count", "type"):
                watched.page.keyboard.press("Escape")
        wait_for(watched, 0)
        assert watched.errors == []


def test_the_plain_form_does_it_without_scripts(chromium: Any, address: str, clinic_day: ClinicDay) -> None:
    context = chromium.new_context(viewport={"width": 768, "height": 1024}, java_script_enabled=False)
    watched = Watched(context.new_page(), address)
    watched.signed_in()
    watched.open(f"/visit-day/{clinic_day.visit}")
    page = watched.page

    def send(selector: str) -> None:
        with page.expect_navigation():
            page.click(selector)

    send("#plain >> text=Start")
    send("#plain button[value='8']")
    page.fill("#plain [name=hz]", "2,35")
    send("#plain >> text=Enter")
    send("#plain button[value=mild] >> nth=0")
    page.fill("#plain [name=text]", "Felt dizzy after Madopar")
    send("#plain >> text=Add the note")
    assert "looks like a name ('Madopar')" in page.inner_text("#plain")
    page.check("#plain [name=no_names_ok]")
    send("#plain >> text=Add the note")
    send("#plain >> text=Stop >> nth=0")
    send("#plain >> text=Finish the session")
    assert "2. " in page.inner_text("#plain h2")
    page.fill("#plain [name=reason]", "no time left")
    send("#plain button:has-text('Skip')")
    context.close()
    assert stored(clinic_day) == ["start", "rating", "grasp", "dyskinesia", "note", "stop", "session_end", "skip"]
