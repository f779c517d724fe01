"""Processes while the database neither answers nor refuses: a stop ends them all the same, and one that cannot go on ends itself."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from sqlalchemy import make_url

from app.settings import get_settings
from tests.network import Line
from tests.ports import free_port

ROOT = Path(__file__).resolve().parents[4]
PATIENCE_S = 300.0

pytestmark = pytest.mark.slow


@pytest.fixture
def line(fresh_database: str) -> Iterator[Line]:
    """The way to the test's database."""
    query = make_url(fresh_database).query
    made = Line(f"{query['host']}/.s.PGSQL.{query.get('port', '5432')}")
    yield made
    made.cut()


@pytest.fixture
def start(line: Line, fresh_database: str, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Starts a program whose database is at the end of the line, and waits for a sentence of its log."""
    url, begun = make_url(fresh_database), []
    log = tmp_path / "log.txt"

    def run(sentence: str, *arguments: str) -> subprocess.Popen[bytes]:
        database = f"postgresql://{url.username}:{url.password}@127.0.0.1:{line.port}/{url.database}"
        env = os.environ | {"BETALOOP_DATABASE_URL": database, "BETALOOP_DATA_DIR": str(get_settings().data_dir)}
        env["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "tests/app/platform/jobs")])
        with log.open("wb") as out:
            process = subprocess.Popen([sys.executable, *arguments], stdout=out, stderr=out, env=env)
        begun.append(process)
        until = time.monotonic() + PATIENCE_S
        while sentence not in log.read_text():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.1)
        return process

    yield run
    for process in begun:
        process.kill()
        process.wait()


def seconds_to_stop(process: subprocess.Popen[bytes]) -> float:
    """Ask a process to stop, and time it."""
    asked = time.monotonic()
    process.send_signal(signal.SIGTERM)
    process.wait(300)
    return time.monotonic() - asked


def test_a_worker_stops_while_the_database_is_silent(line: Line, start: Callable[..., subprocess.Popen[bytes]]) -> None:
    worker = start("takes jobs", "-m", "app.cli", "worker", "--slots", "1")
    line.silence()
    time.sleep(6)  # its beat, every 5 s, waits for an answer
    assert seconds_to_stop(worker) < 20, "10 s are promised; the machine may be busy"


def test_a_web_stops_while_the_database_is_silent(line: Line, start: Callable[..., subprocess.Popen[bytes]]) -> None:
    port = free_port()
    web = start("startup complete", "-m", "app.cli", "serve", "--port", str(port))
    line.silence()

    def ask() -> None:
        with suppress(OSError):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=60)

    asking = threading.Thread(target=ask)
    asking.start()
    time.sleep(2)
    assert seconds_to_stop(web) < 20, "10 s are promised; the machine may be busy"
    asking.join()


def test_a_worker_whose_beat_is_overdue_ends_itself(line: Line, start: Callable[..., subprocess.Popen[bytes]]) -> None:
    code = "import logging; logging.basicConfig(level='INFO'); import sample_job_kinds as kinds; kinds.work(1, 0.5, 3.0)"
    worker = start("takes jobs", "-c", code)
    time.sleep(2)  # a beat counts from the first
    line.silence()
    assert worker.wait(PATIENCE_S) == 1
