"""Uploads while the bucket does not answer: those beyond a number are refused at once, and pages keep their pace."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text

from app.ingest.uploads import in_progress
from app.platform import bucket as buckets
from app.platform.database import new_session
from app.settings import get_settings
from tests.app.ingest.conftest import steady
from tests.network import Line
from tests.s3_server import NAME, Server


@pytest.fixture
def line(s3_server: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    """The way to the bucket."""
    made = Line(s3_server.port)
    monkeypatch.setenv("BETALOOP_FILES_URL", f"s3://{NAME}/at-once")
    monkeypatch.setenv("BETALOOP_FILES_ENDPOINT", f"http://127.0.0.1:{made.port}")
    get_settings.cache_clear()
    yield made
    made.cut()
    get_settings.cache_clear()


@pytest.mark.slow
def test_uploads_that_wait_for_the_bucket_hold_no_more_than_their_places(
    send: Any, client: TestClient, line: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(in_progress, "_places", threading.BoundedSemaphore(1))
    monkeypatch.setattr(buckets, "SLOW_S", 0.0)
    line.silence()
    answers: list[Any] = []
    waiting = threading.Thread(target=lambda: answers.append(send(("t.csv", steady(1)), visit=1, controller="random")))
    waiting.start()
    until = time.monotonic() + 60
    store = buckets.bucket()
    assert store is not None
    while not store.is_slow():
        assert time.monotonic() < until
        time.sleep(0.02)

    with new_session() as db:  # the harness's own connection is this one
        held = text("select count(*) from pg_stat_activity where datname = current_database() and state like 'idle in%'")
        assert db.scalar(held) == 0, "a transaction waits for the bucket"
    refused = send(("u.csv", steady(2)), visit=1, controller="random")
    assert (refused.status_code, refused.json()["title"]) == (503, "The store of files is not available")
    assert int(refused.headers["retry-after"]) > 0
    assert client.get("/api/v1/participants").status_code == 200
    assert answers == [], "the first one waits still"

    line.resume()
    waiting.join()
    assert answers[0].status_code == 201
    assert send(("u.csv", steady(2)), visit=1, controller="random").status_code == 201


def test_an_upload_without_a_place_is_told_to_come_again(send: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = threading.BoundedSemaphore(1)
    taken.acquire()
    monkeypatch.setattr(in_progress, "_places", taken)
    refused = send(("t.csv", steady(1)), visit=1, controller="random")
    assert (refused.status_code, refused.json()["title"]) == (503, "Too many uploads at once")
    assert refused.headers["retry-after"] == "20"
    taken.release()
    assert send(("t.csv", steady(1)), visit=1, controller="random").status_code == 201
