"""Every page by axe-core, light and dark, wide and narrow; nothing moves, nor runs past its card on paper. Makes the tour's pictures."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from app.settings import get_settings
from tests.app.evaluations import behaviour, judged, made_elsewhere, predicted
from tests.app.evaluations import judge as judge
from tests.browser import tour
from tests.ml.ope.posterior.draws import constructed

pytestmark = [pytest.mark.browser, pytest.mark.slow]

PAGES = {
    "today": "/",
    "participant": "/participants/P1",
    "visits": "/participants/P1/visits",
    "visit": "/visits/1",
    "session": "/sessions/{session}",
    "upload": "/participants/P1/upload",
    "proposals": "/participants/P1/proposals",
    "ranking": "/participants/P1/ranking",
    "policies": "/participants/P1/policies",
    "analyses": "/participants/P1/analyses",
    "five-metrics": "/participants/P1/analyses/paper",
    "plans": "/participants/P1/plans",
    "jobs": "/participants/P1/jobs",
    "all-jobs": "/jobs",
    "settings": "/participants/P1/settings",
    "margins": "/participants/P1/margins",
    "all-participants": "/analyses",
    "search": "/search?q=x",
    "audit": "/audit",
    "accounts": "/accounts",
    "account": "/account",
    "interface": "/api-reference",
    "style-guide": "/styleguide",
}
RANKED = {
    "evaluate/ranking": "/participants/P1/ranking",
    "evaluate/policy": "/participants/P1/policies/{policy}",
    "evaluate/compare": "/participants/P1/compare",
    "plan/plan": "/visits/{visit}/plan",
    "plan/visit": "/visits/{visit}",
}
"""Of a participant who has a ranking, and a draft of a plan with its best policy."""
DOSES = {"rl-01": 0.82, "rl-02": 0.68, "rl-03": 0.45, "rl-04": 0.04}
"""Of the ranking's policies, fraction of cDBS."""
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]}
SHIFTS = """() => new Promise((done) => {
  let sum = 0;
  new PerformanceObserver((list) => { for (const e of list.getEntries()) if (!e.hadRecentInput) sum += e.value; })
    .observe({ type: "layout-shift", buffered: true });
  setTimeout(() => done(sum), 100);
})"""
MOST_SHIFT = 0.04
"""Cumulative layout shift, until charts and late parts have come, up to which a page counts as steady: less than half of the limit for
good. On a busy machine a page comes in parts. Fields of a line find their widths when the last has come: up to 0.02, with a processor
slowed down twelve times.
"""
INKS = """() => [...document.querySelectorAll("svg.drawing :is(text, path, line, circle, rect)")]
  .map((e) => `${e.tagName} ${getComputedStyle(e).fill} ${getComputedStyle(e).stroke}`)"""

SHEET = 703
"""Pixels that are printed of a sheet of A4, between the margins of print.css."""


def test_on_paper_nothing_runs_past_its_card(window: Callable, study_world: list[int], monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[type-arg]
    monkeypatch.setattr(get_settings(), "development", True)
    watched = window(SHEET, 900, "light")
    watched.signed_in()
    watched.page.emulate_media(media="print")
    found: list[str] = []
    for name, path in PAGES.items():
        watched.open(path.format(session=study_world[0]))
        found += [f"{name}: {what}" for what in watched.on_paper()]
    assert found == []


def test_on_paper_settings_and_margins_have_their_values(window: Callable, study_world: list[int]) -> None:  # type: ignore[type-arg]
    watched = window(SHEET, 900, "light")
    watched.signed_in()
    watched.page.emulate_media(media="print")
    for page, field in (("settings", "cdbs_amplitude_ma"), ("margins", "rating_points")):
        watched.open(f"/participants/P1/{page}")
        assert watched.page.is_visible(f"form.print [name={field}]")
        assert watched.page.input_value(f"form.print [name={field}]")
        assert not watched.page.is_visible("form.print [name=reason]")
        assert not watched.page.is_visible("form.print button")


WINDOWS = pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (768, "light"), (768, "dark")])


@WINDOWS
def test_no_page_breaks_a_rule_of_accessibility_or_moves(
    window: Callable,
    study_world: list[int],
    monkeypatch: pytest.MonkeyPatch,
    width: int,
    scheme: str,  # type: ignore[type-arg]
) -> None:
    monkeypatch.setattr(get_settings(), "development", True)
    addresses = {name: path.format(session=study_world[0]) for name, path in PAGES.items()}
    assert looked_at(window(width, 900, scheme), addresses) == []


def test_the_first_tick_of_a_ranking_is_fifteen_tabs_away_at_most(ranked: dict[str, int], window: Callable) -> None:  # type: ignore[type-arg]
    watched = window(1280, 900, "light")
    watched.signed_in()
    watched.open(RANKED["evaluate/ranking"])
    keys = 0
    while not watched.page.evaluate("() => document.activeElement.matches('input[name=policy_ids]')"):
        assert keys < 15
        skips = watched.page.evaluate("() => document.activeElement.matches('a.skip[href=\"#candidates\"]')")
        watched.page.keyboard.press("Enter" if skips else "Tab")
        keys += 1
    watched.page.keyboard.press("Space")
    assert watched.page.evaluate("() => document.activeElement.checked")


@WINDOWS
def test_the_pages_of_a_ranking_break_no_rule_either(
    ranked: dict[str, int],
    window: Callable,
    width: int,
    scheme: str,  # type: ignore[type-arg]
) -> None:
    watched = window(width, 900, scheme)
    addresses = {name: path.format(**ranked) for name, path in RANKED.items()}
    assert looked_at(watched, addresses, (width, scheme) == (1280, "light")) == []
    watched.page.emulate_media(media="print")
    watched.page.set_viewport_size({"width": SHEET, "height": 900})
    for path in addresses.values():
        watched.open(path)
        assert watched.on_paper() == [], path
    watched.open(RANKED["evaluate/ranking"])
    assert watched.page.is_visible("#candidates"), "what is ranked is on paper too"
    assert watched.page.locator("#candidates tbody tr").filter(visible=True).count() >= 3


def test_drawings_come_to_paper_in_the_light_colours(ranked: dict[str, int], window: Callable) -> None:  # type: ignore[type-arg]
    """As charts do: the ranking's picture and a comparison are SVG of the page itself; in the system's dark and in the chosen one."""
    inks: dict[str, list[list[str]]] = {}
    for scheme in ("light", "dark", "chosen"):
        watched = window(1280, 900, "light" if scheme == "chosen" else scheme)
        watched.sign_in()
        if scheme == "chosen":
            watched.page.click("[data-theme-toggle]")
            watched.page.wait_for_selector("html[data-theme=dark]")
        for name in ("evaluate/ranking", "evaluate/compare"):
            watched.open(RANKED[name].format(**ranked))
            for media in ("screen", "print"):
                watched.page.emulate_media(media=media)
                inks.setdefault(f"{scheme} {media}", []).append(watched.page.evaluate(INKS))
            watched.page.emulate_media(media="screen")
    assert all(len(found) >= 5 for found in inks["light print"])
    assert inks["dark screen"] != inks["light screen"] != inks["chosen screen"]
    assert inks["dark print"] == inks["chosen print"] == inks["light print"]


def looked_at(watched: Any, addresses: dict[str, str], for_the_tour: bool = False) -> list[str]:
    """List what axe-core and the eye for shifts find on pages; take pictures of them on request."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    pictures = os.environ.get("BETALOOP_TOUR") if for_the_tour else None
    watched.signed_in()
    found: list[str] = []
    for name, path in addresses.items():
        watched.open(path)
        watched.settled()
        watched.page.evaluate("() => scrollTo(0, 0)")
        if (moved := watched.page.evaluate(SHIFTS)) > MOST_SHIFT:
            found.append(f"{name}: moves by {moved:.2f}")
        broken = axe.run(watched.page, options=RULES).response["violations"]
        found += [f"{name}: {v['id']} {v['nodes'][0]['html'][:120]}" for v in broken]
        if pictures:
            tour.take(watched.page, pictures, name)
    return found


@pytest.fixture
def policies(client: TestClient, study_world: list[int]) -> list[int]:
    """Ids of four policies made elsewhere, for the participant whom `study_world` made."""
    return made_elsewhere(client, DOSES)


@pytest.fixture
def ranked(client: TestClient, policies: list[int], judge: Callable[..., int]) -> dict[str, int]:
    """A ranking of which one policy is worth a test, one with care, one is unsafe and one nearly off; a draft with the best."""
    rng = np.random.default_rng(5)
    doses = dict(zip(policies, DOSES.values(), strict=True))
    posterior = {i: judged(50.0 * d, supported=d != 0.68, **predicted(d, rng)) for i, d in doses.items()}
    judge(posterior, constructed("cdbs", **predicted(1.0, rng)).to_json(), coverage=behaviour(doses))
    visit = client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2046-04-06"}).json()["id"]
    assert client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": policies[:1]}).status_code == 201
    return {"policy": policies[0], "visit": visit}
