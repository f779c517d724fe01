"""The tour of the pages has a paragraph and a picture of each, and each picture is small enough for git."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from tests.app.pages.every_page import ELSEWHERE, routes
from tests.browser import tour

ROOT = Path(__file__).resolve().parents[3]
TEXT = (ROOT / "docs" / "tour.md").read_text()
NOT_PAGES = re.compile(r"\.(csv|svg|zip|json|js|pdf)$|/progress$|/visit-day/(key|shell)$|^/analyses/figure$|^/energy-saved/")


def test_every_page_has_a_paragraph_and_a_picture_in_the_tour(service_app: Any) -> None:
    pages = {route for route in routes(service_app) if route not in ELSEWHERE and not NOT_PAGES.search(route)}
    assert pages == set(tour.PAGES)
    pictures = re.findall(r"^!\[[^\]]+\]\(tour/([\w/-]+)\.png\)$", TEXT, re.M)
    assert sorted(pictures) == sorted([*tour.PAGES.values(), *tour.PARTS])
    for name in pictures:
        before = TEXT[: TEXT.index(f"(tour/{name}.png)")].rsplit("![", 1)[0].rstrip()
        assert not before.endswith(")"), f"{name} has no paragraph before it"


def test_every_picture_of_the_tour_is_shown_and_small() -> None:
    files = {path.relative_to(ROOT / "docs" / "tour").with_suffix("").as_posix(): path for path in (ROOT / "docs" / "tour").rglob("*.*")}
    assert set(files) == {*tour.PAGES.values(), *tour.PARTS}
    for name, path in files.items():
        assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n", name
        assert path.stat().st_size <= tour.MOST_BYTES, name
