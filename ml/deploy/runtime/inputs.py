"""Sources of the lines of a device side: standard input, a TCP connection on loopback, a file that grows. Each is read by a thread.

The runner waits on one queue, with its own clock. Sender and receiver may stop or go away, and the loop goes on.
"""

from __future__ import annotations

import os
import select
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable
from enum import Enum
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple, Protocol

from .protocol import LONGEST_LINE

_LOOK_EVERY_S = 0.02
"""How often a growing file is looked at."""
MOST_WAITING = 1000
"""Lines that wait to be read; more than that is a flood, which is not kept."""


class Event(Enum):
    """Event other than a line."""

    LINE = "line"
    LOST = "lost"  # the device is gone; another may come
    ENDED = "ended"  # nothing more will come
    STOP = "stop"  # a person at the tablet ends the session


class Arrival(NamedTuple):
    """Something that came, and when, on the runner's clock in seconds. `text`: the line, of an event `LINE`."""

    at_s: float
    event: Event
    text: str = ""


class DeviceGone(OSError):
    """The receiver of the amplitudes is gone."""


class Link(Protocol):
    """Both directions between the runner and a device side, and the clock."""

    def now(self) -> float:
        """Read a clock that never runs back and does not stop while the tablet sleeps, in seconds."""

    def next(self, until_s: float) -> Arrival | None:
        """Wait for what comes next; None where nothing came until a time of the clock."""

    def send(self, line: str) -> None:
        """Hand a line over. Raises DeviceGone where there is no receiver."""


def monotonic_s() -> float:
    """Count the seconds since the machine started, its sleep included: a beta amplitude from before a sleep is old."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


class QueueLink:
    """A link whose lines come from threads.

    Args:
        write: takes the runner's lines; standard output where not given.
    """

    def __init__(self, write: Callable[[str], None] | None = None) -> None:
        self._arrivals: SimpleQueue[Arrival] = SimpleQueue()
        self._write = write or _to_standard_output

    def now(self) -> float:
        """Read the clock, as `Link.now`."""
        return monotonic_s()

    def put(self, event: Event, text: str = "") -> None:
        """Hand on what came, at once and from any thread or signal handler."""
        if event is not Event.LINE or self._arrivals.qsize() < MOST_WAITING:
            self._arrivals.put(Arrival(self.now(), event, text))

    def next(self, until_s: float) -> Arrival | None:
        """Wait for the next arrival, as `Link.next`."""
        try:
            return self._arrivals.get(timeout=max(0.0, until_s - self.now()))
        except Empty:
            return None

    def send(self, line: str) -> None:
        """Hand a line over, as `Link.send`."""
        try:
            self._write(line)
        except OSError as error:
            raise DeviceGone(str(error)) from error


def from_lines(lines: Iterable[str]) -> QueueLink:
    """Read lines as they come, such as those of standard input; their end ends the session."""
    link = QueueLink()

    def pump() -> None:
        try:
            for line in lines:
                link.put(Event.LINE, line)
        finally:
            link.put(Event.ENDED)

    _start(pump)
    return link


def from_growing_file(path: Path) -> QueueLink:
    """Read whole lines that are added to a file from now on. A file that shrinks, or goes, is a lost device."""
    link, follower = QueueLink(), _Follower(path)

    def pump() -> None:
        while True:
            for event, text in follower.look():
                link.put(event, text)
            time.sleep(_LOOK_EVERY_S)

    _start(pump)
    return link


class _Follower:
    """Text that a file has got since the last look; its first content is past."""

    def __init__(self, path: Path) -> None:
        self._path, self._rest = path, b""
        state = self._state()
        self._inode, self._at = state if state is not None else (-1, 0)

    def look(self) -> list[tuple[Event, str]]:
        state = self._state()
        if state is None:
            lost, self._inode, self._at, self._rest = self._inode >= 0, -1, 0, b""
            return [(Event.LOST, "")] if lost else []
        inode, size = state
        events: list[tuple[Event, str]] = []
        if inode != self._inode or size < self._at:
            events = [(Event.LOST, "")] if self._inode >= 0 else []
            self._inode, self._at, self._rest = inode, 0, b""
        with self._path.open("rb") as stream:
            stream.seek(self._at)
            content = stream.read(1_000_000)
        self._at += len(content)
        *whole, self._rest = (self._rest + content).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            whole, self._rest = [*whole, self._rest], b""
        return events + [(Event.LINE, line.decode("ascii", "replace")) for line in whole]

    def _state(self) -> tuple[int, int] | None:
        try:
            found = self._path.stat()
        except FileNotFoundError:
            return None
        return found.st_ino, found.st_size


class LoopbackLink(QueueLink):
    """One device side at a time on a port of this machine alone; lines in both directions over the one connection.

    Args:
        port: 0 for any free one, which `port` then gives.

    Raises:
        OSError: the port cannot be opened.
    """

    def __init__(self, port: int) -> None:
        super().__init__(self._to_device)
        self._server = socket.create_server(("127.0.0.1", port))
        self.port = int(self._server.getsockname()[1])
        self._device: socket.socket | None = None
        self._greeting = ""
        _start(self._accept)

    def _to_device(self, line: str) -> None:
        """Send to the connected device. One that takes nothing is cut off: the loop never waits."""
        if line.startswith("controller "):
            self._greeting = line
        device = self._device
        if device is None:
            return
        try:
            if not select.select([], [device], [], 0.0)[1]:
                raise OSError("the device takes no more lines")
            device.sendall(line.encode("ascii"))
        except OSError:
            self._drop(device)

    def _accept(self) -> None:
        while True:
            connection, _ = self._server.accept()
            if self._device is not None:
                connection.close()  # one device, and the first one keeps its place
                continue
            connection.settimeout(None)
            if self._greeting:
                connection.sendall(self._greeting.encode("ascii"))
            self._device = connection
            _start(partial(self._read, connection))

    def _read(self, device: socket.socket) -> None:
        rest = b""
        try:
            while content := device.recv(4096):
                *whole, rest = (rest + content).split(b"\n")
                if len(rest) > LONGEST_LINE:
                    whole, rest = [*whole, rest], b""
                for line in whole:
                    self.put(Event.LINE, line.decode("ascii", "replace"))
        except OSError as error:
            self.put(Event.LINE, f"# {error}")  # no message: it is logged with the loss that follows
        self._drop(device)

    def _drop(self, device: socket.socket) -> None:
        if self._device is device:
            self._device = None
            self.put(Event.LOST)
        device.close()

    def close(self) -> None:
        """Give the port back."""
        self._server.close()
        if self._device is not None:
            self._device.close()


def _to_standard_output(line: str) -> None:
    sys.stdout.write(line)
    sys.stdout.flush()


def give_up_standard_output() -> None:
    """Redirect standard output after its reader went away: what is left to write at exit goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _start(work: Callable[[], None]) -> None:
    threading.Thread(target=work, daemon=True).start()
