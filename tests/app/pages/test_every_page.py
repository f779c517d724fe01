"""Every page that the service has answers, is small over the wire, and a reader of results meets no word of the methods."""

from __future__ import annotations

import re
import zlib

from fastapi.testclient import TestClient

from app.settings import get_settings
from tests.app.every_route import PASSWORD, World
from tests.app.pages.every_page import ELSEWHERE, addresses, routes
from tests.app.words import above_fold, methods_named, miscounted

MOST_BYTES = 60_000
METHODS_EXPLAINED = {"/glossary": "says what the words of the folds mean"}
"""Pages that are about these words."""


def test_every_address_of_a_browser_answers_and_every_page_is_small(world: World) -> None:
    assert set(ELSEWHERE) <= set(routes(world.app))
    reader = TestClient(world.app, headers={"Accept": "text/html", "Accept-Encoding": "gzip"}, follow_redirects=False)
    assert reader.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 303
    refused, large, pages = {}, {}, 0
    get_settings().development = True
    for route, path in addresses(world).items():
        with reader.stream("get", path) as answer:
            if answer.status_code not in (200, 303):
                refused[route] = answer.status_code
            if not answer.headers.get("content-type", "").startswith("text/html"):
                continue
            sent = b"".join(answer.iter_raw())
        pages += 1
        assert answer.headers["content-encoding"] == "gzip", route
        assert zlib.decompress(sent, 31).rstrip().endswith(b"</html>"), route
        if len(sent) > MOST_BYTES:
            large[route] = len(sent)
    assert refused == {}, "give the page a row to show in every_page.py"
    assert large == {}
    assert pages >= 50


def test_no_page_meets_its_reader_with_words_of_the_methods_and_energy_has_one_unit(world: World) -> None:
    reader = TestClient(world.app, headers={"Accept": "text/html"}, follow_redirects=False)
    assert reader.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 303
    found: dict[str, list[str]] = {}
    shares, counts = [], {}
    for route, path in addresses(world).items():
        with reader.stream("get", path) as answer:
            if answer.status_code != 200 or not answer.headers["content-type"].startswith("text/html"):
                continue
            page = answer.read().decode()
        found[route] = methods_named(above_fold(page))
        # a number in one element and a noun in the next are no count
        counts[route] = miscounted(" ".join(re.sub("<[^>]+>", " | ", page).split()))
        # the REST interface keeps shares of the energy under cDBS, and its reference says so
        shares += [route] if "cDBS = 1" in page and route != "/api-reference" else []
    assert len(found) >= 50
    assert {route for route, words in found.items() if words} == set(METHODS_EXPLAINED), {r: w for r, w in found.items() if w}
    assert {route: said for route, said in counts.items() if said} == {}
    assert shares == [], "energy is told in % of cDBS"
