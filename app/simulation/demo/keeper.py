"""The process of a running demo: it waits for the web service, the worker and the loader of the study, and stops them.

`betaloop demo` becomes this process once its page is up. The libraries it needed until then hold 0.3 GB, so this module imports none.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from typing import Protocol

    class Service(Protocol):
        """A running service, as `subprocess.Popen` is one."""

        def poll(self) -> int | None:
            """Return its exit code, or None while it runs."""

        def terminate(self) -> None:
            """Ask it to end."""

        def kill(self) -> None:
            """End it."""


MODULE = "app.simulation.demo.keeper"
ENDING = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
STOP_TIMEOUT_S = 20.0
ENDED_BY_ITSELF = "The web service or the worker ended by itself."
NOT_LOADED = "The demo's study could not be loaded; started again, the demo goes on where it was."
READY = "\n  Ready. Ctrl-C stops the demo and keeps its data; `make demo` starts it again."
_POLL_S = 0.05
_LOOK_S = 1.0


class OwnChild:
    """A child of this process that is known by its number alone: the object that started it went with the former program."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._code: int | None = None

    def poll(self) -> int | None:
        """Return its exit code, or None while it runs."""
        if self._code is None:
            ended, status = os.waitpid(self._pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if ended else None
        return self._code

    def terminate(self) -> None:
        """Ask it to end."""
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        self._send(signal.SIGKILL)

    def _send(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self._pid, number)


def become_keeper(pids: Sequence[int], logs: Path, loads: bool) -> NoReturn:
    """Replace the program of this process by the keeper of its children.

    Args:
        pids: the children, in the order of their start.
        logs: folder with their logs, named where one of them ends by itself.
        loads: the last child loads the study and ends when it is loaded.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)  # the new program inherits the mask
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", MODULE, str(logs), str(int(loads)), *map(str, pids)])  # noqa: S606 - our own words, no shell


def stop(services: Sequence[Service]) -> None:
    """End services in order, the one started last first; those that take longer than STOP_TIMEOUT_S are killed."""
    for service in reversed(services):
        service.terminate()
    for service in services:
        deadline = time.monotonic() + STOP_TIMEOUT_S
        while service.poll() is None:
            if time.monotonic() > deadline:
                service.kill()
            time.sleep(_POLL_S)


def main(arguments: Sequence[str]) -> int:
    """Wait until a signal comes or a service ends, stop what runs, and return the exit code: 1 where a service ended by itself.

    Signals stay blocked and are asked for. A handler that raises can be lost where Python calls it within a destructor.
    """
    logs, loads, *pids = arguments
    services = [OwnChild(int(pid)) for pid in pids]
    loader = services.pop() if loads == "1" else None
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    problem, ready = None, False
    while problem is None:
        if signal.sigtimedwait(ENDING, _LOOK_S) is not None:
            _say("\n  Stopping …")
            break
        if any(service.poll() is not None for service in services):
            problem = ENDED_BY_ITSELF
        elif loader is not None and (code := loader.poll()) is not None:
            loader = None
            problem = NOT_LOADED if code else None
        elif loader is None and not ready:
            _say(READY)
            ready = True
    if problem is not None:
        sys.stderr.write(f"betaloop: {problem} See the files in {logs}.\n")
    stop([*services, *([loader] if loader is not None else [])])
    # a service that was killed could not stop the database that it used last
    os.spawnv(os.P_WAIT, sys.executable, [sys.executable, "-m", "app.platform.embedded.server"])  # noqa: S606 - our own words, no shell
    return 0 if problem is None else 1


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
