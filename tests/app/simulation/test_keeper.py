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

from app.simulation.keeper import MODULE

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
from app.simulation.keeper import become_keeper
folder = Path(sys.argv[1])
started = [subprocess.Popen([sys.executable, "-c", {SERVICE!r}, name, str(folder)]) for name in ("web", "worker")]
while not all((folder / name).exists() for name in ("web", "worker")):
    time.sleep(0.05)
become_keeper((one.pid for one in started), folder / "log")
"""


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[psutil.Popen]:
    """A process that has two services and has become their keeper."""
    process = psutil.Popen([sys.executable, "-c", PROGRAM, str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
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
    said, complained = demo.communicate(timeout=60)
    assert (demo.returncode, said.strip(), complained) == (0, "Stopping …", "")
    assert not [one for one in services if one.is_running()]
    assert set((tmp_path / "ended").read_text().split()) == {"web", "worker"}


def test_a_service_that_ends_by_itself_ends_the_demo_with_a_sentence(demo: psutil.Popen, tmp_path: Path) -> None:
    web, worker = demo.children()
    web.kill()
    said, complained = demo.communicate(timeout=60)
    assert (demo.returncode, said) == (1, "")
    assert complained == f"betaloop: The web service or the worker ended by itself. See the files in {tmp_path / 'log'}.\n"
    assert not worker.is_running()
    assert (tmp_path / "ended").read_text().split() == ["worker"]
