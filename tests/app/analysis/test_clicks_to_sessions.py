"""From every table of the analyses, the sessions behind its numbers are a click away, or next to them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient

BASE = "/participants/P1/analyses"
SESSION = re.compile(r'href="(/sessions/\d+)"')
WITHOUT_SESSIONS = ("battery", "readings", "computation")
"""Cards of what no session brought."""


def page(client: TestClient, path: str) -> str:
    """Load a page without its charts, whose tables repeat their points."""
    answer = client.get(path)
    assert answer.status_code == 200, path
    shown = re.sub(r"<figure.*?</figure>", "", answer.text, flags=re.DOTALL)
    for card in WITHOUT_SESSIONS:
        shown = re.sub(rf'<section[^>]*id="{card}".*?</section>', "", shown, flags=re.DOTALL)
    return shown


def behind(client: TestClient, place: str, shown: str) -> list[str]:
    """List the sessions that a link names, or that are in the row, the card or the page of visits to which it leads."""
    if place.startswith("/sessions/"):
        return [place]
    if "/analyses/visits/" in place and "#" not in place:
        return SESSION.findall(page(client, place))
    path, _, mark = place.partition("#")
    found = re.search(rf'<(tr|section)\b[^>]*\bid="{re.escape(mark)}".*?</\1>', page(client, path) if path else shown, re.DOTALL)
    return SESSION.findall(found[0]) if mark and found else []


@pytest.mark.parametrize(
    ("path", "least"),
    [
        (BASE, 8),
        (f"{BASE}/paper", 7),
        (f"{BASE}/models/rl", 10),
        (f"{BASE}/energy", 4),
        (f"{BASE}/beta", 6),
        ("/analyses", 6),
        ("/trial-time", 1),
    ],
)
def test_rows_with_numbers_lead_to_sessions(client: TestClient, add_visits: Callable[..., None], path: str, least: int) -> None:
    add_visits(6, medication_h=1.0)
    shown = page(client, path)
    rows = [r for r in re.findall(r"<tr\b.*?</tr>", shown, re.DOTALL) if re.search(r">[^<]*[1-9]", r) and "<th" not in r]
    assert len(rows) >= least
    for row in rows:
        assert any(behind(client, link, shown) for link in re.findall(r'href="([^"]+)"', row)), row


def test_a_point_of_a_chart_opens_its_session(client: TestClient, add_visits: Callable[..., None]) -> None:
    add_visits(3)
    for path in (f"{BASE}/paper", f"{BASE}/beta"):
        scripts = re.findall(r'<script type="application/json">(.*?)</script>', client.get(path).text, re.DOTALL)
        traces = [t for s in scripts for t in json.loads(s).get("data", []) if t.get("mode") == "markers"]
        assert traces, path
        for trace in traces:
            assert client.get(f"{trace['meta']}{trace['customdata'][0]}").status_code == 200
