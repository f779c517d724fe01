"""Answers are compressed for our own pages and for programs, never for another site, and never a stream of events."""

from __future__ import annotations

import pytest
from fastapi import FastAPI
from fastapi.responses import HTMLResponse, StreamingResponse
from fastapi.testclient import TestClient

from app.platform.web.compression import Compression
from app.settings import get_settings

TEXT = "<p>amplitude and beta</p>" * 200


@pytest.fixture
def service() -> TestClient:
    app = FastAPI()
    app.add_middleware(Compression)
    app.get("/page")(lambda: HTMLResponse(TEXT))
    app.get("/events")(lambda: StreamingResponse(iter(["data: 1\n\n"] * 500), media_type="text/event-stream"))
    return TestClient(app)


@pytest.mark.parametrize("site", ["same-origin", "none", None])
def test_our_own_pages_and_programs_get_a_compressed_page(service: TestClient, site: str | None) -> None:
    answer = service.get("/page", headers={"Sec-Fetch-Site": site} if site else {})
    assert answer.headers["content-encoding"] == "gzip"
    assert "accept-encoding" in answer.headers["vary"].lower()
    assert int(answer.headers["content-length"]) < len(TEXT) / 10
    assert answer.text == TEXT


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_what_another_site_asked_for_tells_nothing_by_its_length(service: TestClient, site: str) -> None:
    answer = service.get("/page", headers={"Sec-Fetch-Site": site, "Cookie": "betaloop_session=x"})
    assert "content-encoding" not in answer.headers
    assert int(answer.headers["content-length"]) == len(TEXT)


def test_a_browser_that_does_not_say_whence_gets_no_compressed_page_over_tls(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BETALOOP_COOKIE_SECURE", "true")
    get_settings.cache_clear()
    try:
        assert "content-encoding" not in service.get("/page", headers={"Cookie": "betaloop_session=x"}).headers
        assert service.get("/page", headers={"Authorization": "Bearer x"}).headers["content-encoding"] == "gzip"
    finally:
        monkeypatch.undo()
        get_settings.cache_clear()


def test_events_are_not_held_back_by_compression(service: TestClient) -> None:
    assert "content-encoding" not in service.get("/events").headers


def test_a_reader_who_takes_no_gzip_gets_none(service: TestClient) -> None:
    answer = service.get("/page", headers={"Accept-Encoding": "identity"})
    assert "content-encoding" not in answer.headers
    assert answer.text == TEXT
