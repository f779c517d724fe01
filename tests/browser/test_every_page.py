"""Every page of the service, of errors and of a sign-on by axe-core with all folds open: light and dark, wide and narrow."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.settings import get_settings
from tests import identity_provider
from tests.app.conftest import full_study as full_study
from tests.app.conftest import world as world
from tests.app.every_route import PASSWORD, TABLE, World, token_of
from tests.app.pages.every_page import addresses
from tests.browser import tour
from tests.browser.conftest import Watched, serving, windows
from tests.browser.test_accessibility import MOST_SHIFT, RULES, SHEET, SHIFTS, WINDOWS
from tests.browser.test_pages_in_chromium import BUTTONS_OVER

pytestmark = [pytest.mark.browser, pytest.mark.slow]

OPEN_FOLDS = "() => { for (const fold of document.querySelectorAll('details')) fold.open = true; scrollTo(0, 0); }"
TOO_WIDE = "() => document.documentElement.scrollWidth - document.documentElement.clientWidth"
SEND = """([action, name, value]) => { const form = document.createElement('form'); form.method = 'post'; form.action = action;
  const field = document.createElement('input'); field.name = name; field.value = value; form.append(field); document.body.append(form);
  form.submit(); }"""
DRAWN = ("/visit-day/shell",)
"""Page that is not opened by its address: a tablet without network draws the clinic day into it."""
SUBMIT = "main form[method=post] button.primary"


@pytest.fixture
def window(chromium: Any, world: World, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Watched]]:
    """Windows on the study in which every page has something to show."""
    monkeypatch.setenv("BETALOOP_DEVELOPMENT", "true")
    get_settings.cache_clear()
    with serving(world.app) as address, windows(chromium, address) as make:
        yield make
    get_settings.cache_clear()


@pytest.fixture
def axe() -> Any:
    """The rules."""
    return pytest.importorskip("axe_playwright_python.sync_playwright").Axe()


def broken(axe: Any, watched: Watched, name: str) -> list[str]:
    """List what axe-core finds on the page that is shown, with its folds open, and whether it is wider than the window."""
    watched.page.evaluate(OPEN_FOLDS)
    watched.charts_drawn()
    watched.page.evaluate("() => scrollTo(0, 0)")
    found = axe.run(watched.page, options=RULES).response["violations"]
    wider = watched.page.evaluate(TOO_WIDE)
    return [f"{name}: {v['id']} {v['nodes'][0]['html'][:160]}" for v in found] + [f"{name}: {wider} px too wide"] * (wider > 0)


def test_the_tour_shows_every_page(window: Callable, world: World) -> None:  # type: ignore[type-arg]
    watched = window(tour.WIDTH, tour.HEIGHT, "light")
    pictures, there = os.environ.get("BETALOOP_TOUR"), addresses(world)
    trained = next(j["id"] for j in world.read("/participants/P1/jobs")["items"] if j["status"] == "succeeded")
    there["/jobs/{job_id}"] = f"/jobs/{trained}"  # which has steps and curves
    for route in ["/sign-in", *(r for r, name in tour.PAGES.items() if r != "/sign-in" and name not in tour.OF_THE_RANKED)]:
        watched.open(there[route])
        assert watched.page.url.endswith(there[route])
        watched.charts_drawn()
        if route == "/visit-day/{visit_id}":
            watched.page.wait_for_selector("#day:not([hidden])")
        watched.page.evaluate("() => scrollTo(0, 0)")
        if pictures:
            tour.take(watched.page, pictures, tour.PAGES[route])
        if route == "/sign-in":
            watched.signed_in(password=PASSWORD)
    session = world.upload("tour.csv", tour.samples(), visit="2", controller="other")["sessions"][0]["id"]
    for name, card in tour.PARTS.items():
        watched.open(f"/sessions/{session}")
        watched.page.locator(card).scroll_into_view_if_needed()
        watched.page.wait_for_selector(f"{card} figure[data-drawn=yes] .heatmaplayer image")
        watched.charts_drawn()
        # below the bar that stays
        watched.page.evaluate("(card) => { document.querySelector(card).scrollIntoView(); scrollBy(0, -70); }", card)
        if pictures:
            tour.take(watched.page, pictures, name)
    assert watched.errors == []


@WINDOWS
def test_every_page_keeps_to_every_rule_and_to_its_place(window: Callable, world: World, axe: Any, width: int, scheme: str) -> None:  # type: ignore[type-arg]
    watched = window(width, 900, scheme)
    watched.signed_in(password=PASSWORD)
    reader = TestClient(world.app, headers={"Accept": "text/html"}, follow_redirects=False)
    reader.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD})
    found, seen = [], 0
    for name, path in addresses(world).items():
        with reader.stream("get", path) as answer:
            html = answer.status_code == 200 and answer.headers["content-type"].startswith("text/html")
        if not html or name in DRAWN:
            continue
        watched.open(path)
        watched.settled()
        if (moved := watched.page.evaluate(SHIFTS)) > MOST_SHIFT:
            found.append(f"{name}: moves by {moved:.3f}")
        found += broken(axe, watched, name)
        # on a tablet the buttons are large, and keep off the title too
        found += [f"{name}: buttons over {c}" for c in watched.page.evaluate(BUTTONS_OVER) if width == 768 or c.endswith("data")]
        seen += 1
    assert "\n".join(found) == ""
    assert seen >= 50
    assert watched.errors == []
    assert watched.foreign == []


def test_on_paper_no_page_has_anything_cut_off(window: Callable[..., Watched], world: World) -> None:
    """Every page, every fold that is open, every chart as it is drawn before printing."""
    watched = window(SHEET, 900, "light")
    watched.page.emulate_media(media="print")
    found, charts, there = [], 0, addresses(world)
    # first what is shown only without a sign-in
    for name in sorted(tour.PAGES, key=lambda route: route != "/sign-in"):
        watched.open(there[name])
        assert watched.page.url == watched.address + there[name]
        found += [f"{name}: {what}" for what in watched.on_paper()]
        found += [f"{name}: {wider} px wider than the sheet"] if (wider := watched.page.evaluate(TOO_WIDE)) > 0 else []
        charts += len(watched.page.query_selector_all("figure[data-drawn=yes]"))
        if name == "/sign-in":
            watched.page.emulate_media(media="screen")
            watched.signed_in(password=PASSWORD)
            watched.page.emulate_media(media="print")
    assert "\n".join(found) == ""
    assert charts >= 20
    assert watched.errors == []


@WINDOWS
def test_pages_of_a_sealed_plan_keep_to_every_rule_and_name_no_controller(
    window: Callable[..., Watched], world: World, axe: Any, width: int, scheme: str
) -> None:
    visit = world.ids_of("post", "/api/v1/visits/{visit_id}/plan/key")["visit_id"]
    number = next(v["number"] for v in world.read("/participants/P2/visits")["items"] if v["id"] == visit)
    stated = {"participant": "P2", "visit": str(number), "controller": "cdbs"}
    session = world.send("/uploads", data=stated, files={"file": ("s.csv", TABLE.replace(b"8,1,1", b"8,1.3,1", 1))})["sessions"][0]["id"]
    watched = window(width, 900, scheme)
    watched.signed_in(password=PASSWORD)
    found = []
    for name, path in (("visit", f"/visits/{visit}"), ("plan", f"/visits/{visit}/plan"), ("session", f"/sessions/{session}")):
        watched.open(path)
        assert "sealed" in watched.page.inner_text("main"), name
        found += broken(axe, watched, name)
    assert "cDBS" not in watched.page.inner_text("main h1")
    assert "\n".join(found) == ""


@WINDOWS
def test_pages_of_errors_keep_to_every_rule(window: Callable, world: World, axe: Any, width: int, scheme: str) -> None:  # type: ignore[type-arg]
    token_of("viewer", name="reader")
    watched = window(width, 900, scheme)
    page, found = watched.page, []

    def look(name: str, heading: str) -> None:
        assert heading in " ".join(page.locator("h1, .note").all_inner_texts()), name
        found.extend(broken(axe, watched, name))

    watched.open("/sign-in")
    look("sign-in", "Sign in")
    page.fill("[name=email]", "admin@clinic.example")
    page.fill("[name=password]", "not this one")
    page.click("main button")
    page.wait_for_selector(".note")
    look("a wrong password", "Sign in")
    watched.sign_in("reader@clinic.example", PASSWORD)
    page.goto(f"{watched.address}/audit")
    look("403", "Not allowed")
    page.context.clear_cookies()
    watched.sign_in(password=PASSWORD)
    page.goto(f"{watched.address}/no/such/page")
    look("404", "There is no such page")
    page.goto(f"{watched.address}/sessions/none")
    look("422", "Something in this request cannot be used")
    page.evaluate(SEND, [f"{watched.address}/participants/P1/visits", "note", "x" * (2 << 20)])
    page.wait_for_selector("h1:text('Too large to take')")
    look("413", "Too large to take")
    watched.open("/participants/P1/visits/new")
    page.fill("[name=number]", "1")
    page.click(SUBMIT)
    page.wait_for_selector(".note.bad")
    assert page.input_value("[name=number]") == "1"
    look("a form that was refused", "visit")
    page.fill("[name=number]", "2046")
    page.context.clear_cookies()
    page.click(SUBMIT)
    page.wait_for_selector("h1:text('Your sign-in has expired')")
    assert "2046" in page.inner_text("main dl")
    look("an expired sign-in", "Your sign-in has expired")
    assert "\n".join(found) == ""


@WINDOWS
def test_the_hospitals_sign_on_and_a_signature_keep_to_every_rule(
    window: Callable[..., Watched], world: World, axe: Any, monkeypatch: pytest.MonkeyPatch, width: int, scheme: str
) -> None:
    watched = window(width, 900, scheme)
    page, found = watched.page, []
    with identity_provider.running(f"{watched.address}/sign-on/return") as hospital:
        named = {"OIDC_ISSUER": hospital.issuer, "OIDC_CLIENT_ID": identity_provider.CLIENT_ID, "OIDC_CLIENT_SECRET": hospital.secret}
        for name, value in (named | {"PUBLIC_URL": watched.address, "OIDC_NAME": "St. Elsewhere"}).items():
            monkeypatch.setenv(f"BETALOOP_{name}", value)
        get_settings.cache_clear()
        hospital.person = identity_provider.Person("x", "nobody@clinic.example")
        watched.open("/sign-in")
        found += broken(axe, watched, "sign-in")
        page.click("text=Continue with St. Elsewhere")
        page.wait_for_selector(".note.bad")
        found += broken(axe, watched, "a sign-on without an account")
        hospital.person, hospital.present = identity_provider.Person("7f3a", "admin@clinic.example"), None
        page.click("text=Continue with St. Elsewhere")
        page.wait_for_selector("a.who")
        watched.open("/account")
        found += broken(axe, watched, "the account")
        plan = addresses(world)["/visits/{visit_id}/plan"]
        watched.open(plan)
        found += broken(axe, watched, "a plan to sign")
        page.click("text=Confirm with St. Elsewhere")
        page.wait_for_selector("#sign .badge.good")
        found += broken(axe, watched, "a plan with a confirmation")
        hospital.person, hospital.present = identity_provider.Person("91bc", "nobody@clinic.example"), None
        page.click("text=Confirm anew with St. Elsewhere")
        page.wait_for_selector(".note.bad")
        found += broken(axe, watched, "somebody else's confirmation")
        watched.open(plan)
        page.click("#sign button.primary")
        page.wait_for_selector("text=Plan signed")
        found += broken(axe, watched, "a signed plan")
    assert "\n".join(found) == ""
