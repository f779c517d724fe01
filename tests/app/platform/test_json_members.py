"""A JSON document that states a member twice is refused, in words that say where; all else passes as it came."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from app.platform.web.request_bodies import doubled_member

JSON = {"Content-Type": "application/json"}


@pytest.mark.parametrize(
    ("body", "place"),
    [
        (b'{"a": 1, "b": [1, {"a": 2}]}', None),
        (b'{"a": 1, "a": 1}', ("body", "a")),
        (b'{"a": [1, {"b": 1, "c": 2, "b": 3}]}', ("body > a > 1", "b")),
        (b'{"a": {"x": 1, "x": 2}, "a": 2}', ("body", "a")),
        ('{"ä": 1, "\\u00e4": 2}'.encode(), ("body", "ä")),
        ('{"a": 1, "a": 2}'.encode("utf-16"), ("body", "a")),
        (b'{"a": 1, "a"', None),
        (b"[" * 100_000, None),
        (b"", None),
    ],
)
def test_a_doubled_member_is_found_where_it_stands(body: bytes, place: tuple[str, str] | None) -> None:
    assert doubled_member(body) == place


@pytest.mark.parametrize("pieces", [1, 3])
def test_a_doubled_member_is_refused_and_nothing_is_stored(client: TestClient, participant_code: str, pieces: int) -> None:
    body = b'{"number": 2, "date": "2026-03-30", "number": 3}'
    step = -(-len(body) // pieces)
    path = f"/api/v1/participants/{participant_code}/visits"
    parts = (body[i : i + step] for i in range(0, len(body), step))
    refused = client.post(path, content=parts if pieces > 1 else body, headers=JSON)
    assert refused.status_code == 422, refused.text
    assert refused.headers["content-type"] == "application/problem+json"
    assert refused.json()["detail"] == "body has the member 'number' more than once."
    assert refused.json()["errors"] == [{"where": "body > number", "what": "stated more than once"}]
    assert refused.headers["x-content-type-options"] == "nosniff"
    assert "2026-03-30" not in client.get(path).text
    taken = client.post(path, content=body.replace(b', "number": 3', b""), headers=JSON)
    assert taken.status_code == 201, taken.text


def test_a_document_that_is_too_large_is_told_so_as_before(client: TestClient) -> None:
    large = b'{"a": 1, "a": "' + b"x" * (2 << 20) + b'"}'
    parts = (large[i : i + 65536] for i in range(0, len(large), 65536))  # states no length
    assert client.post("/api/v1/participants", content=parts, headers=JSON).status_code == 413
