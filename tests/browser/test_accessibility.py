"""Every page by axe-core, light and dark, wide and narrow; nothing moves, nor runs past its card on paper. Makes the tour's pictures."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from app.settings import get_settings

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
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]}
SHIFTS = """() => new Promise((done) => {
  let sum = 0;
  new PerformanceObserver((list) => { for (const e of list.getEntries()) if (!e.hadRecentInput) sum += e.value; })
    .observe({ type: "layout-shift", buffered: true });
  setTimeout(() => done(sum), 100);
})"""
MOST_SHIFT = 0.1
"""Cumulative layout shift up to which a page counts as steady."""


PAST_THE_CARD = """() => [...document.querySelectorAll("main .card")].flatMap((card) =>
  [...card.querySelectorAll("table, figure, svg.drawing, dl, pre")].filter((e) => e.getBoundingClientRect().width)
    .map((e) => [e.tagName, Math.round(e.getBoundingClientRect().right - card.getBoundingClientRect().right)]))
  .filter(([, past]) => past > 0).map(([tag, past]) => `${tag} by ${past} px`)"""
SHEET = 703
"""Pixels that are printed of a sheet of A4, between the margins of print.css."""


def test_on_paper_nothing_runs_past_its_card(window: Callable, studied: list[int], monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[type-arg]
    monkeypatch.setattr(get_settings(), "development", True)
    watched = window(SHEET, 900, "light")
    watched.sign_in()
    watched.page.emulate_media(media="print")
    found: list[str] = []
    for name, path in PAGES.items():
        watched.open(path.format(session=studied[0]))
        found += [f"{name}: {what}" for what in watched.page.evaluate(PAST_THE_CARD)]
    assert found == []


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (768, "light"), (768, "dark")])
def test_no_page_breaks_a_rule_of_accessibility_or_moves(
    window: Callable,
    studied: list[int],
    monkeypatch: pytest.MonkeyPatch,
    width: int,
    scheme: str,  # type: ignore[type-arg]
) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    monkeypatch.setattr(get_settings(), "development", True)
    pictures = os.environ.get("BETALOOP_TOUR") if (width, scheme) == (1280, "light") else None
    watched = window(width, 900, scheme)
    watched.sign_in()
    found: list[str] = []
    for name, path in PAGES.items():
        watched.open(path.format(session=studied[0]))
        watched.charts_drawn()
        watched.page.evaluate("() => scrollTo(0, 0)")
        if (moved := watched.page.evaluate(SHIFTS)) > MOST_SHIFT:
            found.append(f"{name}: moves by {moved:.2f}")
        broken = axe.run(watched.page, options=RULES).response["violations"]
        found += [f"{name}: {v['id']} {v['nodes'][0]['html'][:120]}" for v in broken]
        if pictures:
            watched.page.screenshot(path=Path(pictures) / f"{name}.png", scale="css")
    assert found == []
