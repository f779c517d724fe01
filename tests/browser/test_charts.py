"""Charts and late parts of pages in a real Chromium: they come, move together, and lead where their words say."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from playwright.sync_api import expect
from sqlalchemy.orm import Session

from tests.app.analysis.conftest import adder
from tests.app.overview.test_samples import lfp_table

pytestmark = pytest.mark.browser

RANGE = "(id) => document.querySelector(`#${id} .plot`)._fullLayout?.xaxis?.range?.map((v) => Math.round(1000 * v) / 1000)"
ZOOM = "([id, range]) => window.Plotly.relayout(document.querySelector(`#${id} .plot`), { 'xaxis.range': range })"


@pytest.fixture
def sampled(client: TestClient, participant_code: str) -> int:
    """A session of 30 s with raw samples at 250 Hz."""
    stated = {"participant": participant_code, "visit": "1", "controller": "cdbs"}
    sent = client.post("/api/v1/uploads", data=stated, files={"file": ("lfp.csv", lfp_table()[0])})
    assert sent.status_code == 201, sent.text
    return int(sent.json()["sessions"][0]["id"])


def test_the_home_page_gets_the_energy_saved_once_it_stands(window: Callable, participant_code: str, db: Session) -> None:  # type: ignore[type-arg]
    adder(db, participant_code)("rl", fraction=0.5)
    watched = window()
    watched.signed_in()
    watched.open("/")
    expect(watched.page.locator("#energy-saved[data-late=here] dd b").first).to_have_text("75")
    expect(watched.page.locator("#energy-saved a", has_text="Show what")).to_have_count(0)
    assert watched.errors == []


def test_a_dot_of_the_months_and_a_row_of_their_table_open_the_session(window: Callable, participant_code: str, db: Session) -> None:  # type: ignore[type-arg]
    session = adder(db, participant_code)("cdbs", grasp=2.0)
    watched = window()
    watched.signed_in()
    watched.open("/participants/P1")
    watched.charts_drawn()
    first = watched.page.locator("#story .scatterlayer .point").first
    first.scroll_into_view_if_needed()
    dot = first.bounding_box()
    watched.page.mouse.move(dot["x"] + dot["width"] / 2, dot["y"] + dot["height"] / 2, steps=3)
    watched.page.wait_for_selector("#story .hoverlayer .hovertext")
    watched.page.mouse.down()
    watched.page.mouse.up()
    watched.page.wait_for_url(f"**/sessions/{session}")
    watched.open("/participants/P1")
    watched.page.focus("#story summary")
    watched.page.keyboard.press("Enter")
    watched.page.keyboard.press("Tab")
    while not watched.page.evaluate("() => document.activeElement.matches('#story td a')"):
        assert watched.page.evaluate("() => Boolean(document.activeElement.closest('#story'))"), "no key leads to a session"
        watched.page.keyboard.press("Tab")
    watched.page.keyboard.press("Enter")
    watched.page.wait_for_url(f"**/sessions/{session}")


def test_raw_samples_are_drawn_and_every_chart_of_the_session_follows_a_zoom(window: Callable, sampled: int) -> None:  # type: ignore[type-arg]
    watched = window()
    watched.signed_in()
    watched.open(f"/sessions/{sampled}")
    watched.page.locator("#signal").scroll_into_view_if_needed()
    watched.page.wait_for_selector("#signal[data-drawn=yes] .scatterlayer path.js-line")
    watched.page.wait_for_selector("#signal .heatmaplayer image")
    watched.charts_drawn()
    expect(watched.page.locator("#signal [data-signal-subtitle]")).to_contain_text("lowest and highest sample of every 32 ms")
    whole = watched.page.evaluate(RANGE, "control")
    # from the beta above to the samples below, which are read again, and back
    watched.page.evaluate(ZOOM, ["control", [0.1, 0.15]])
    watched.page.wait_for_function(f"({RANGE})('signal').join() === '0.1,0.15'")
    expect(watched.page.locator("#signal [data-signal-subtitle]")).to_contain_text("every sample")
    assert watched.page.evaluate(RANGE, "signal") == [0.1, 0.15], "the samples that came later keep the stretch"
    watched.page.evaluate(ZOOM, ["signal", [0.2, 0.3]])
    watched.page.wait_for_function(f"({RANGE})('control').join() === '0.2,0.3'")
    watched.page.evaluate("() => window.Plotly.relayout(document.querySelector('#signal .plot'), { 'xaxis.autorange': true })")
    watched.page.wait_for_function(f"(whole) => ({RANGE})('control').join() === whole.join()", arg=whole)
    expect(watched.page.locator("#signal [data-signal-subtitle]")).to_contain_text("lowest and highest sample of every 32 ms")
    assert watched.errors == []
    assert watched.foreign == []
