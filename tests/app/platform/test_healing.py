"""A database that dies under the running service, or whose disk is full: reported in true words, and repaired without a person."""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import httpx2 as httpx
import psycopg
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select, text
from sqlalchemy.exc import IntegrityError, OperationalError

from app import main
from app.platform.database import Db, get_engine, new_session
from app.platform.embedded.server import EmbeddedPostgres
from app.platform.errors import NotFound
from app.settings import get_settings
from benchmarks.installed.installation import PASSWORD, STARTED_S, Server, installation
from tests.app.platform.test_stops import data as data
from tests.app.platform.test_stops import start, wait_for

HEALTHY_WITHIN_S = 10.0
"""On processors that have nothing else to do; `patience` gives more where others wait for them."""


def patience() -> float:
    """Return the seconds to wait, by how many processes share each processor."""
    return HEALTHY_WITHIN_S * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_service_whose_database_was_killed_heals_by_itself() -> None:
    with installation() as installed:
        token = installed.add_people({"admin@clinic.example": "admin"})["admin@clinic.example"]
        installed.start("web 1")
        installed.wait_until("the first answer", installed.webs_are_ready, STARTED_S)
        with httpx.Client(base_url=installed.bases[0], headers={"Accept": "text/html"}, timeout=patience()) as browser:
            form = {"email": "admin@clinic.example", "password": PASSWORD}
            assert browser.post("/sign-in", data=form, headers={"Sec-Fetch-Site": "same-origin"}).status_code == 303
            bearer = {"Authorization": f"Bearer {token}", "Accept": "application/json", "Cookie": ""}
            for path, headers in (("/healthz", {}), ("/", {}), ("/api/v1/participants", bearer)):
                killed_and_healed(installed.database, lambda path=path, headers=headers: browser.get(path, headers=headers))
        assert installed.processes["web 1"].poll() is None


def killed_and_healed(server: Server, ask: Callable[[], httpx.Response]) -> None:
    """Kill a database and ask until the answer is right again: meanwhile 503 in words with Retry-After, and at least once that."""
    assert ask().status_code == 200
    os.kill(server.pid(), signal.SIGKILL)
    killed, refused = time.monotonic(), []
    while (answer := ask()).status_code != 200 or not refused:
        assert time.monotonic() - killed < patience(), answer.text
        if answer.status_code != 200:
            refused.append(answer)
        time.sleep(0.02)
    assert {a.status_code for a in refused} == {503}
    assert all(a.headers["retry-after"] == "5" for a in refused)
    assert all("The database does not answer for the moment." in a.text for a in refused)


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


@pytest.mark.parametrize("status", [200, 404])
def test_an_answer_stands_whose_database_goes_away_after_it_was_made(fresh_database: str, status: int) -> None:
    service = main.create_app()

    @service.get("/read")
    def read(db: Db) -> dict[str, int]:
        pid = db.scalar(select(func.pg_backend_pid()))
        with new_session() as other:
            other.execute(text("select pg_terminate_backend(:pid, 5000)"), {"pid": pid})
        if status == 404:
            raise NotFound("There is none.")
        return {"read": 1}

    with TestClient(service) as browser:
        assert [browser.get("/read").status_code for _ in range(3)] == [status] * 3
        assert get_engine().pool.checkedout() == 0  # type: ignore[attr-defined]


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
        worker.wait(300)
