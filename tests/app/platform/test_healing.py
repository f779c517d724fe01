"""A database that dies under the running service, or whose disk is full: told in true words, and mended without a person."""

from __future__ import annotations

import errno
import os
import signal
import time
from pathlib import Path

import httpx2 as httpx
import psycopg
import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import IntegrityError, OperationalError

from app import main
from app.platform.embedded.server import EmbeddedPostgres
from app.settings import get_settings
from tests.app.platform.test_stops import data as data
from tests.app.platform.test_stops import free_port, start, wait_for

HEALTHY_WITHIN_S = 10.0
"""On processors that have nothing else to do; `patience` gives more where others wait for them."""


def patience() -> float:
    """Seconds, by how many processes share each processor."""
    return HEALTHY_WITHIN_S * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


@pytest.mark.slow
def test_a_service_whose_database_was_killed_heals_by_itself(data: Path) -> None:
    port = free_port()
    service = start(data, "serve", "--port", str(port))
    url = f"http://127.0.0.1:{port}/healthz"
    try:
        wait_for(data, "running on", service)
        server = EmbeddedPostgres(data / "postgres", server_user=get_settings().server_user)
        for _ in range(2):
            assert httpx.get(url).status_code == 200
            os.kill(server.pid(), signal.SIGKILL)
            killed, answers = time.monotonic(), []
            while not answers or answers[-1].status_code != 200:
                assert time.monotonic() - killed < patience(), [a.text for a in answers[-1:]]
                answers.append(httpx.get(url, timeout=patience()))
                time.sleep(0.05)
            refused = [a for a in answers if a.status_code != 200]
            assert {a.status_code for a in refused} <= {503}
            assert all(a.headers["retry-after"] == "5" for a in refused)
        assert service.poll() is None
    finally:
        service.send_signal(signal.SIGTERM)
        service.wait(30)


def test_a_server_that_lives_is_left_alone(tmp_path: Path) -> None:
    server = EmbeddedPostgres(tmp_path / "postgres", durable=False, server_user=get_settings().server_user)
    assert not server.heal()  # not started by us: nothing to heal
    server.start()
    try:
        before = server.pid()
        assert not server.heal()
        os.kill(before, signal.SIGKILL)
        deadline = time.monotonic() + HEALTHY_WITHIN_S
        while not server.heal() and time.monotonic() < deadline:  # a killed process is there for a moment yet
            time.sleep(0.01)
        assert server.pid() != before
    finally:
        server.remove()
    assert not server.heal()


class _Refused(Exception):
    def __init__(self, sqlstate: str | None) -> None:
        super().__init__("the server said no")
        self.sqlstate = sqlstate


@pytest.mark.parametrize(
    ("error", "status", "title"),
    [
        (OperationalError("select 1", {}, _Refused(None)), 503, "The database is not available"),
        (OperationalError("select 1", {}, _Refused("57P03")), 503, "The database is not available"),
        (OperationalError("select 1", {}, _Refused("53300")), 503, "The database is not available"),
        (OperationalError("select 1", {}, _Refused("40P01")), 503, "Another request stood in the way"),
        (IntegrityError("insert", {}, _Refused("23503")), 409, "Not possible in the present state"),
        (OperationalError("insert", {}, _Refused("53100")), 507, "The disk is full"),
        (OSError(errno.ENOSPC, "No space left on device"), 507, "The disk is full"),
        (OperationalError("select 1", {}, _Refused("57014")), 500, "Something went wrong on our side."),
        (OSError(errno.EACCES, "Permission denied"), 500, "Something went wrong on our side."),
    ],
)
@pytest.mark.parametrize("accept", ["application/json", "text/html"])
def test_what_fails_beneath_is_told_in_true_words(
    monkeypatch: pytest.MonkeyPatch, fresh_database: str, error: Exception, status: int, title: str, accept: str
) -> None:
    def fails(_: object) -> None:
        raise error

    monkeypatch.setattr(main, "check_connection", fails)
    answer = TestClient(main.create_app(), raise_server_exceptions=False).get("/healthz", headers={"accept": accept})
    assert answer.status_code == status
    assert title in answer.text
    assert ("retry-after" in answer.headers) == (status == 503)
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert "select 1" not in answer.text


@pytest.mark.slow
def test_a_worker_whose_database_was_killed_goes_on(data: Path) -> None:
    worker = start(data, "worker")
    try:
        wait_for(data, "takes jobs", worker)
        server = EmbeddedPostgres(data / "postgres", server_user=get_settings().server_user)
        os.kill(server.pid(), signal.SIGKILL)
        killed = time.monotonic()
        while True:
            assert worker.poll() is None, (data / "said.txt").read_text()
            assert time.monotonic() - killed < 3 * HEALTHY_WITHIN_S, (data / "said.txt").read_text()
            try:
                with psycopg.connect(server.admin_conninfo("betaloop")) as connection:
                    (silent_s,) = connection.execute("select extract(epoch from clock_timestamp() - max(seen_at)) from worker").fetchone()
            except psycopg.OperationalError:
                continue
            finally:
                time.sleep(0.2)
            if silent_s < time.monotonic() - killed - HEALTHY_WITHIN_S / 10:
                break  # it gave a sign of life after the kill
    finally:
        worker.send_signal(signal.SIGTERM)
        worker.wait(30)
