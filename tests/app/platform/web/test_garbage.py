"""Pages do not wait for a search through everything that the service keeps."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

REQUESTS = 40


@pytest.fixture
def searches() -> Iterator[list[int]]:
    """Generations that were searched for garbage since, in their order."""
    found: list[int] = []

    def note(phase: str, info: dict[str, Any]) -> None:
        if phase == "start":
            found.append(info["generation"])

    gc.callbacks.append(note)
    yield found
    gc.callbacks.remove(note)


def test_requests_search_the_youngest_objects_alone(client: TestClient, participant_code: str, searches: list[int]) -> None:
    client.get(f"/participants/{participant_code}")  # loads what the first page loads
    gc.collect()  # whatever earlier tests left to be searched
    searches.clear()
    for _ in range(REQUESTS):
        assert client.get(f"/participants/{participant_code}", headers={"Accept": "text/html"}).status_code == 200
    assert 0 in searches, "garbage in circles does go"
    assert len(searches) < REQUESTS
    assert 2 not in searches, "what the service keeps is not looked through"
