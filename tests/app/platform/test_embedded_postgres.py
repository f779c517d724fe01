"""The embedded PostgreSQL under the faults that happen to laptops."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psycopg
import pytest

from app.platform.embedded.server import EmbeddedPostgres


@pytest.fixture
def server(tmp_path: Path):  # type: ignore[no-untyped-def]
    server = EmbeddedPostgres(tmp_path / "postgres")
    server.start()
    yield server
    server.remove()


def connect(server: EmbeddedPostgres) -> psycopg.Connection:
    return psycopg.connect(server.owner_url("betaloop").replace("+psycopg", ""), autocommit=True)


def test_what_was_committed_survives_kill_9_of_the_postmaster(server: EmbeddedPostgres, tmp_path: Path) -> None:
    with connect(server) as connection:
        assert connection.execute("show fsync").fetchone() == ("on",)
        connection.execute("create table kept (n int)")
        connection.execute("insert into kept values (7)")
    os.kill(server.pid(), signal.SIGKILL)
    again = EmbeddedPostgres(tmp_path / "postgres")
    again.start()
    try:
        with connect(again) as connection:
            assert connection.execute("select n from kept").fetchone() == (7,)
    finally:
        again.leave()


def test_the_server_outlives_one_of_two_users_and_not_the_last(tmp_path: Path) -> None:
    folder = tmp_path / "postgres"
    code = (
        "import sys, pathlib; from app.platform.embedded.server import EmbeddedPostgres as E;"
        f"s = E(pathlib.Path({str(folder)!r})); s.start(); print(s.pid(), flush=True); sys.stdin.readline()"
    )
    users = [
        subprocess.Popen([sys.executable, "-W", "ignore", "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    pids = {int(u.stdout.readline()) for u in users if u.stdout}
    assert len(pids) == 1
    users[0].communicate("\n", timeout=30)
    assert Path(f"/proc/{pids.copy().pop()}").exists()
    users[1].communicate("\n", timeout=30)
    deadline = time.monotonic() + 10
    while Path(f"/proc/{min(pids)}").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not Path(f"/proc/{min(pids)}").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has another user's server to keep out of its home")
def test_a_closed_home_stays_closed(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir(mode=0o700)
    server = EmbeddedPostgres(home / "data" / "postgres")
    (home / "data").mkdir()
    server.start()
    try:
        with connect(server) as connection:
            assert connection.execute("select 1").fetchone() == (1,)
        assert home.stat().st_mode & 0o077 == 0
    finally:
        server.remove()
