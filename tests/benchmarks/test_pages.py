"""The benchmark of pages asks for every page of the service, at an address that is one."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

from tests.browser import tour

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "pages.py"


def measured() -> dict[str, str]:
    """Return the addresses that the script requests, by their names there."""
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


@pytest.mark.parametrize(("first_ms", "meets"), [([90.0, 120.0], True), ([90.0, 900.0], False), ([300.0, 300.0], False)])
def test_the_first_drawing_of_samples_is_told_beside_the_worst_page_with_whether_it_meets_the_aim(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], first_ms: list[float], meets: bool
) -> None:
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    pages = importlib.import_module("benchmarks.pages")
    found = {"home": pages.Measured([50.0, 60.0], [1.0], [1000], [3]), "signal, first": pages.Measured(first_ms)}
    figures = pages.report(found)
    assert figures["worst_p95_ms"] == 59.5
    assert figures["first_signal_meets_aim"] is meets
    assert figures["first_signal_p95_ms"] == round(first_ms[0] + 0.95 * (first_ms[1] - first_ms[0]), 1)
    assert f"{'meets' if meets else 'misses'} the aim of 150 and 400 ms" in capsys.readouterr().out
