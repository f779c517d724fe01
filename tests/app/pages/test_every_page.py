"""Every page that the service has answers, is small over the wire, and a reader of results meets no word of the methods."""

from __future__ import annotations

import zlib

from fastapi.testclient import TestClient

from app.settings import get_settings
from tests.app.every_route import PASSWORD, World
from tests.app.pages.every_page import ELSEWHERE, addresses, routes

MOST_BYTES = 60_000


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
