"""The benchmark of pages asks for every page of the service, at an address that is one."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from tests.browser import tour

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "pages.py"


def measured() -> dict[str, str]:
    """Addresses that the script asks for, by what it calls them."""
    tree = ast.parse(SCRIPT.read_text())
    (pages,) = [n.value for n in tree.body if isinstance(n, ast.Assign) and getattr(n.targets[0], "id", "") == "PAGES"]
    found: dict[str, str] = ast.literal_eval(pages)
    return found


def test_every_page_of_the_service_is_measured() -> None:
    paths = [re.sub(r"\{\w+\}", "1", address).split("?")[0] for address in measured().values()]
    # a literal place wins: /participants/new is no participant
    routes = sorted(tour.PAGES, key=lambda route: route.count("{"))
    pages = {route: re.compile(re.sub(r"\{\w+\}", "[^/]+", route)) for route in routes}
    found = {path: next((route for route, form in pages.items() if form.fullmatch(path)), None) for path in paths}
    assert set(tour.PAGES) - set(found.values()) == set()
    assert [path for path, route in found.items() if route is None] == ["/sessions/1/signal.json"], (
        "which draws a chart of the session's page"
    )
