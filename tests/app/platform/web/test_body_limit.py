"""How large a request may be: files up to the upload limit, everything that is parsed in memory 1 MiB."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fastapi.testclient import TestClient

from app.platform.web.body_limit import PLAIN_LIMIT


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
