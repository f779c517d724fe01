"""Size of a request: files up to the upload limit, everything that is parsed in memory 1 MiB."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient
from structlog.testing import capture_logs

from app.platform.web.request_bodies import PLAIN_LIMIT


@pytest.mark.parametrize("content_type", ["application/json", "application/x-www-form-urlencoded", ""])
def test_a_large_document_is_refused_before_it_is_read(client: TestClient, content_type: str) -> None:
    body = b" " * (PLAIN_LIMIT + 1)
    answer = client.post("/api/v1/participants", content=body, headers={"content-type": content_type})
    assert answer.status_code == 413
    assert answer.json()["detail"] == "The request is larger than 1 MiB and has no file in it."
    assert "multipart/form-data" in answer.json()["hint"]
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_document_that_states_no_length_is_cut_off(client: TestClient) -> None:
    def endless() -> Iterator[bytes]:
        for _ in range(PLAIN_LIMIT // 1000 + 10):
            yield b" " * 1000

    answer = client.post("/api/v1/participants", content=endless(), headers={"content-type": "application/json"})
    assert answer.status_code == 413


def test_a_document_within_the_limit_is_read(client: TestClient) -> None:
    answer = client.post("/api/v1/participants", content=b" " * (PLAIN_LIMIT - 10) + b"{}", headers={"content-type": "application/json"})
    assert answer.status_code == 422


def test_who_leaves_before_the_whole_form_has_come_fills_no_log(client: TestClient) -> None:
    sent: list[dict[str, Any]] = []
    parts = iter([{"type": "http.request", "body": b"email=a", "more_body": True}, {"type": "http.disconnect"}])

    async def receive() -> dict[str, Any]:
        return next(parts)

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    form = (b"content-type", b"application/x-www-form-urlencoded")
    scope = {"type": "http", "method": "POST", "path": "/sign-in", "query_string": b"", "headers": [form], "client": ("127.0.0.1", 1)}
    scope |= {"server": ("testserver", 80), "scheme": "http", "http_version": "1.1", "raw_path": b"/sign-in", "root_path": ""}
    with capture_logs() as logs:
        asyncio.run(client.app(scope, receive, send))
    assert [line for line in logs if line["log_level"] in ("warning", "error")] == []
