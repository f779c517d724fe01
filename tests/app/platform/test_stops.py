"""A stop of `serve`, `worker` or `demo` from outside leaves no PostgreSQL and no other process behind."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from app.platform.embedded.server import EmbeddedPostgres
from app.settings import get_settings
from tests.ports import free_port

ROOT = Path(__file__).resolve().parents[3]
SIGNALS = [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]


@pytest.fixture
def data() -> Iterator[Path]:
    folder = Path("/tmp") / f"betaloop-stops-{os.getpid()}-{os.urandom(4).hex()}"
    folder.mkdir()
    folder.chmod(0o711)
    yield folder
    for process in left_in(folder):
        process.kill()
    EmbeddedPostgres(folder / "postgres", server_user=get_settings().server_user).remove()
    shutil.rmtree(folder)


def left_in(data: Path) -> list[psutil.Process]:
    """List processes that name the data folder: the database, web services, workers."""
    found = []
    for process in psutil.process_iter():
        try:
            words = " ".join(process.cmdline()) + process.environ().get("BETALOOP_DATA_DIR", "")
        except psutil.Error:
            continue
        if str(data) in words and process.pid != os.getpid():
            found.append(process)
    return found


def _as_a_background_job() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # what a shell without job control gives to a command that ends in `&`


def start(data: Path, *command: str) -> subprocess.Popen[bytes]:
    env = {k: v for k, v in os.environ.items() if not k.startswith("BETALOOP_") or k == "BETALOOP_SERVER_USER"}
    env |= {"BETALOOP_DATA_DIR": str(data), "PYTHONPATH": str(ROOT)}
    with (data / "said.txt").open("wb") as out:
        return subprocess.Popen(
            [sys.executable, "-m", "app.cli", *command], cwd=ROOT, stdout=out, stderr=out, env=env, preexec_fn=_as_a_background_job
        )


def wait_for(data: Path, sentence: str, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 400
    while sentence not in (said := (data / "said.txt").read_text()):
        assert process.poll() is None, said
        assert time.monotonic() < deadline, said
        time.sleep(0.1)


def assert_nothing_left(data: Path) -> None:
    deadline = time.monotonic() + 60
    while (left := left_in(data)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left
    assert not (data / "postgres" / "postmaster.pid").exists()


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize(("command", "running"), [("serve", "Application startup complete"), ("worker", "takes jobs")])
def test_a_stopped_service_leaves_nothing_behind(data: Path, command: str, running: str, number: int) -> None:
    process = start(data, command, *(["--port", str(free_port())] if command == "serve" else []))
    wait_for(data, running, process)
    assert (data / "postgres" / "postmaster.pid").exists()
    process.send_signal(number)
    process.wait(300)
    assert_nothing_left(data)


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_a_stopped_demo_leaves_nothing_behind(data: Path, number: int) -> None:
    process = start(data, "demo", "--port", str(free_port()))
    wait_for(data, "password", process)
    process.send_signal(number)
    process.wait(90)
    assert_nothing_left(data)


@pytest.mark.slow
def test_a_stop_during_the_start_leaves_nothing_behind(data: Path) -> None:
    process = start(data, "serve", "--port", str(free_port()))
    deadline = time.monotonic() + 120
    while not (data / "postgres" / "postmaster.pid").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.terminate()
    process.wait(300)
    assert_nothing_left(data)
