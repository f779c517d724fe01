"""`betaloop demo`: everything on one machine, with a small synthetic study that enters through the public upload path.

Started again, it finds its study and serves it within seconds. Interrupted, it goes on. Simulated sessions have fixed numbers and the day
of the demo's start is kept, so that earlier uploads are recognised by their bytes.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2 as httpx
import psutil
from rich.console import Console

from app.platform.database import now
from app.platform.errors import BetaloopError, Conflict
from app.platform.upkeep.migrate import migrate
from app.platform.upkeep.start import require_data_folder, require_free
from app.settings import get_settings, private_folder
from app.simulation.demo.accounts import add_accounts
from app.simulation.demo.keeper import ENDED_BY_ITSELF, ENDING, become_keeper, stop
from app.simulation.demo.loader import State

START_TIMEOUT_S = 180.0

console = Console()


class DemoFailed(BetaloopError):
    """The demo cannot go on."""


def run_demo(host: str, port: int) -> None:
    """Start the database, the web service and a worker, load the study, run the first pipelines, and serve until Ctrl-C."""
    settings = get_settings()
    os.environ["BETALOOP_DATA_DIR"] = str(settings.data_dir.resolve())
    url = f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}"  # noqa: S104
    require_free(host, port)
    require_data_folder()
    started = time.monotonic()
    with _only_demo(settings.data_dir, url):
        with console.status("Starting the database …"):
            try:
                migrate()
            except RuntimeError as error:
                raise DemoFailed(f"{error}; or start a new demo in another folder: BETALOOP_DATA_DIR=FOLDER") from error
            password = add_accounts(settings.data_dir)
        os.environ["BETALOOP_DEMO"] = "true"
        with _children(settings.data_dir / "log", host, port) as children:
            with console.status("Starting the web service and a worker …"):
                _wait_until_up(url, host, port, children)
            say_welcome(url, time.monotonic() - started, password)
            loader = _start_loader(url, settings.data_dir / "demo.json")
            if loader is not None:
                children.append(loader)
            become_keeper([child.pid for child in children], settings.data_dir / "log", loads=loader is not None)


@contextmanager
def _only_demo(folder: Path, url: str) -> Iterator[None]:
    """Lock the data folder for this demo, also for its keeper. Raises Conflict if another demo runs in it."""
    with (folder / "demo.lock").open("a+") as lock:
        os.set_inheritable(lock.fileno(), True)  # the keeper is this process with another program
        lock.seek(0)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            address = lock.read() or "an address that it has not printed yet"
            raise Conflict(
                f"A demo of the data folder {folder} runs already, at {address}.", "Use it, or name another folder in BETALOOP_DATA_DIR."
            ) from None
        lock.truncate()
        lock.write(url)
        lock.flush()
        yield


def _say(line: str) -> None:
    """Print a line to the terminal or a log; never wrapped, so that an address or a password stays next to its label."""
    console.print(line, soft_wrap=True, highlight=False)


def say_welcome(url: str, seconds: float, password: str) -> None:
    """Print address, accounts and password, each on a line of its own."""
    _say(f"\n  [bold]betaloop is up[/bold] after {seconds:.0f} s")
    _say(f"  address:  [bold underline]{url}[/]")
    _say("  sign in:  [bold]clinician@demo.example[/], engineer@demo.example or admin@demo.example")
    _say(f"  password: [bold]{password}[/]")
    _say("  The four participants are synthetic: simulated, and not fitted to patients.\n")


@contextmanager
def _children(logs: Path, host: str, port: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Run the web service and the worker as child processes with log files; stop both at the end."""
    private_folder(logs)
    commands = {"web": ["serve", "--host", host, "--port", str(port)], "worker": ["worker"]}
    children: list[subprocess.Popen[bytes]] = []
    previous = [(number, signal.signal(number, _interrupt)) for number in ENDING]
    try:
        for name, arguments in commands.items():
            with (logs / f"{name}.log").open("ab") as log:
                # a session of its own: Ctrl-C reaches this process alone, which then stops the others in order
                command = [sys.executable, "-m", "app.cli", *arguments]
                children.append(subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True))
        yield children
    except KeyboardInterrupt:
        _say("\n  Stopping …")
    finally:
        impatient = [(number, signal.signal(number, signal.SIG_IGN)) for number in ENDING]
        stop(children)
        for number, handler in (*impatient, *previous):
            signal.signal(number, handler)


_interrupted = threading.Event()


def _interrupt(_number: int, _frame: Any) -> None:
    """End the demo. The exception is lost where Python calls this within a destructor, so `_check` looks at the flag too."""
    _interrupted.set()
    raise KeyboardInterrupt


def _wait_until_up(url: str, host: str, port: int, children: list[subprocess.Popen[bytes]]) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        if children[0].poll() is not None:
            require_free(host, port)  # which another program may have taken meanwhile
        _check(children)
        try:
            # another betaloop may answer at this address, until our own service finds that it cannot listen there
            if httpx.get(f"{url}/healthz", timeout=2).status_code == 200 and _listens(children[0], port):
                return
        except httpx.TransportError:
            pass
        time.sleep(0.2)
    raise DemoFailed(f"The web service did not answer within {START_TIMEOUT_S:.0f} s.", _log_hint())


def _listens(child: subprocess.Popen[bytes], port: int) -> bool:
    try:
        connections = psutil.Process(child.pid).net_connections("tcp")
    except psutil.NoSuchProcess:
        return False
    return any(c.status == psutil.CONN_LISTEN and c.laddr.port == port for c in connections)


def _check(children: list[subprocess.Popen[bytes]]) -> None:
    if _interrupted.is_set():
        raise KeyboardInterrupt
    if any(child.poll() is not None for child in children):
        raise DemoFailed(ENDED_BY_ITSELF, _log_hint())


def _log_hint() -> str:
    return f"See the files in {get_settings().data_dir / 'log'}."


def _start_loader(url: str, state_path: Path) -> subprocess.Popen[bytes] | None:
    """Start the process that loads the study, whose simulation needs memory that nothing else does; None where all is loaded."""
    if State.at(state_path, now().date()).complete:
        return None
    return subprocess.Popen([sys.executable, "-m", "app.simulation.demo.loader", url, str(state_path)], start_new_session=True)
