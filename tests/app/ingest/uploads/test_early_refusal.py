"""Refusal of an upload before the body of the request is read."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient

CHUNK = bytes(1 << 16)
CHUNKS = 100


def post_in_chunks(app: Any, path: str, headers: dict[str, str]) -> tuple[int, int]:
    """Send a POST whose body comes in chunks; return its status, and how many chunks were read."""
    taken, status = 0, 0
    head = b'--x\r\nContent-Disposition: form-data; name="file"; filename="a.csv"\r\n\r\n'

    async def receive() -> dict[str, Any]:
        nonlocal taken
        taken += 1
        return {"type": "http.request", "body": head if taken == 1 else CHUNK, "more_body": taken < CHUNKS}

    async def send(message: dict[str, Any]) -> None:
        nonlocal status
        status = message.get("status", status)

    raw = {"host": "testserver", "content-type": "multipart/form-data; boundary=x", "content-length": str(CHUNKS * len(CHUNK))} | headers
    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": "POST",
        "scheme": "http",
        "path": path,
        "raw_path": path.encode(),
        "root_path": "",
        "query_string": b"",
        "headers": [(name.encode(), value.encode()) for name, value in raw.items()],
        "client": ("test", 1),
        "server": ("testserver", 80),
    }
    asyncio.run(app(scope, receive, send))
    return status, taken


@pytest.mark.parametrize("path", ["/api/v1/uploads", "/participants/P1/upload"])
@pytest.mark.parametrize(("role", "status"), [(None, 401), ("viewer", 403)])
def test_a_caller_who_may_not_upload_is_refused_before_the_body_is_read(
    client: TestClient, service_app: Any, participant_code: str, make_token: Callable[[str], str], path: str, role: str | None, status: int
) -> None:
    headers = {"authorization": f"Bearer {make_token(role)}"} if role else {}
    got, taken = post_in_chunks(service_app, path, headers)
    assert taken <= 1
    assert got in ((status,) if path.startswith("/api") or role else (401, 303))


def test_a_caller_who_may_upload_is_read_to_the_end(service_app: Any, participant_code: str, make_token: Callable[[str], str]) -> None:
    _, taken = post_in_chunks(service_app, "/api/v1/uploads", {"authorization": f"Bearer {make_token('engineer')}"})
    assert taken >= CHUNKS
