"""The process of a running demo: small, stops its services in order, and says when one ended by itself."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.simulation.demo import command
from app.simulation.demo.keeper import MODULE, READY
from tests.ports import free_port

SERVICE = """
import signal, sys, time
from pathlib import Path
name, folder = sys.argv[1:]
def end(*_):
    with open(folder + "/ended", "a") as out:
        out.write(name + " ")
    sys.exit(0)
signal.signal(signal.SIGTERM, end)
Path(folder, name).touch()
while True:
    time.sleep(0.1)
"""
PROGRAM = f"""
import subprocess, sys, time
from pathlib import Path
import numpy  # of the libraries that the former program needed
from app.simulation.demo.keeper import become_keeper
folder = Path(sys.argv[1])
started = [subprocess.Popen([sys.executable, "-c", {SERVICE!r}, name, str(folder)]) for name in ("web", "worker")]
while not all((folder / name).exists() for name in ("web", "worker")):
    time.sleep(0.05)
loader = sys.argv[2:] and subprocess.Popen([sys.executable, "-c", sys.argv[2]])
become_keeper([one.pid for one in [*started, *([loader] if loader else [])]], folder / "log", loads=bool(loader))
"""


@pytest.fixture
def demo(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[psutil.Popen]:
    """A process that became the keeper of two services, and of a loader where the test names its program."""
    loader = getattr(request, "param", [])
    process = psutil.Popen(
        [sys.executable, "-c", PROGRAM, str(tmp_path), *loader], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 300
    while MODULE not in process.cmdline():
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    services = process.children()
    yield process
    for one in (process, *services):
        if one.is_running():
            one.kill()


def test_it_holds_no_library(demo: psutil.Popen) -> None:
    time.sleep(0.5)
    mapped = {Path(m.path).name for m in demo.memory_maps()}
    assert not [name for name in mapped if "numpy" in name or "multiarray" in name]
    assert demo.memory_full_info().uss < 12 << 20


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_the_services_and_then_itself(demo: psutil.Popen, tmp_path: Path, number: int) -> None:
    services = demo.children()
    assert len(services) == 2
    demo.send_signal(number)  # also one that comes before the keeper can handle it
    said, complained = demo.communicate(timeout=300)
    assert (demo.returncode, said.replace(READY, "").strip(), complained) == (0, "Stopping …", "")
    assert not [one for one in services if one.is_running()]
    assert set((tmp_path / "ended").read_text().split()) == {"web", "worker"}


def test_a_service_that_ends_by_itself_ends_the_demo_with_a_sentence(demo: psutil.Popen, tmp_path: Path) -> None:
    web, worker = demo.children()
    web.kill()
    said, complained = demo.communicate(timeout=300)
    assert (demo.returncode, said.replace(READY, "").strip()) == (1, "")
    assert complained == f"betaloop: The web service or the worker ended by itself. See the files in {tmp_path / 'log'}.\n"
    assert not worker.is_running()
    assert (tmp_path / "ended").read_text().split() == ["worker"]


@pytest.mark.parametrize("demo", [["pass"]], indirect=True)
def test_it_says_when_the_study_is_loaded_and_goes_on(demo: psutil.Popen) -> None:
    assert demo.stdout is not None
    assert "".join(demo.stdout.readline() for _ in range(2)).rstrip("\n") == READY
    assert demo.poll() is None
    demo.send_signal(signal.SIGINT)
    assert demo.wait(300) == 0


@pytest.mark.parametrize("demo", [["import sys; sys.exit(1)"]], indirect=True)
def test_a_study_that_cannot_be_loaded_ends_the_demo_with_a_sentence(demo: psutil.Popen, tmp_path: Path) -> None:
    _, complained = demo.communicate(timeout=300)
    assert demo.returncode == 1
    assert complained.startswith("betaloop: The demo's study could not be loaded; started again, the demo goes on where it was.")
    assert set((tmp_path / "ended").read_text().split()) == {"web", "worker"}


@pytest.mark.parametrize("demo", [["import time; time.sleep(600)"]], indirect=True)
def test_a_signal_stops_the_loader_too(demo: psutil.Popen) -> None:
    children = demo.children()
    assert len(children) == 3
    demo.send_signal(signal.SIGINT)
    assert demo.wait(300) == 0
    assert not [one for one in children if one.is_running()]


def test_a_demo_of_another_version_says_how_to_start_a_new_one(fresh_database: str, owner_db: Session) -> None:
    owner_db.execute(text("update alembic_version set version_num = 'initial'"))
    owner_db.commit()
    with pytest.raises(command.DemoFailed, match=r"does not know the schema .*initial.*another folder: BETALOOP_DATA_DIR=FOLDER"):
        command.run_demo("127.0.0.1", free_port())
