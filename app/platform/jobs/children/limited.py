"""Functions that work on untrusted files, each call in a forked child with its own limits, so that a crash harms no other process.

The slots of a worker are shared fairly between jobs.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from app.platform.errors import no_room
from app.platform.files import draft_folder
from app.platform.jobs.children.child import Cause, ChildLimits
from app.platform.jobs.children.forked import MODULE, ForkedProcesses
from app.platform.jobs.children.supervisor import ChildMessages, ComputeCall
from app.settings import get_settings

PREPARED = ("app.ingest.uploads.compute:prepare", f"{MODULE}:use_large_pages")
"""Names of what children import in advance: the platform is below the phases and may not import them. A file takes two forks."""
IDLE_S = 120.0
"""Time after the last file at which the process that forks readers ends, seconds: files of one sitting come within two minutes."""
WALL_PER_CPU = 5
"""A child may take so many times its limit of processor time by the clock, on a machine that has other work too."""


class ChildEnded(Exception):
    """A call in a child gave no result.

    Attributes:
        cause: why. limits: those it ran under. log: the end of the child's log, which quotes nothing of the file.
    """

    def __init__(self, cause: Cause, limits: ChildLimits, log: str) -> None:
        super().__init__(f"the child ended: {cause}")
        self.cause, self.limits, self.log = cause, limits, log


class _OutOfTime(Exception):
    """The clock's limit of a call is over."""


_guard = threading.Lock()
_shared: list[tuple[int, ForkedProcesses, Slots]] = []
"""The children of this process: its number, their starter, and how many may work at once."""


def run_limited(
    reference: str,
    params: dict[str, Any],
    limits: ChildLimits,
    record: Callable[[float | None, str | None], None] = lambda *_: None,
    who: str = "",
) -> dict[str, Any]:
    """Call a compute function (`module:function`) in a child and give its result.

    Args:
        reference: the function; it takes all it needs from its params, for its process knows no settings of ours.
        params: JSON. Files are named by paths that the child can open.
        limits: what it may take.
        record: takes the progress that it reports, a share and a few words, either of them None where it did not change.
        who: calls of one name wait for each other's turn where there are more calls than may work at once.

    Raises:
        ChildEnded: it met a limit, broke down or raised. StorageFull: the disk had no room for what it wrote.
    """
    children, slots = _children()
    wall_s = None if limits.cpu_s is None else float(WALL_PER_CPU * limits.cpu_s)
    with slots.hold(who, lambda: None), draft_folder() as folder:
        begun = time.monotonic()

        def check() -> None:
            if wall_s is not None and time.monotonic() - begun > wall_s:
                raise _OutOfTime

        def told(messages: ChildMessages) -> None:
            record(messages.progress, messages.message)

        call = ComputeCall("limited", reference, params, folder / "call", limits)
        try:
            outcome = children.run(call, told, check)
        except _OutOfTime:
            raise ChildEnded("time", limits, "") from None
    if outcome["ok"]:
        result: dict[str, Any] = outcome["result"]
        return result
    if outcome["cause"] == "full":
        raise no_room()
    raise ChildEnded(outcome["cause"], limits, outcome["log"])


def prepare() -> None:
    """Start the process that forks children, where a call is likely to come soon. If it cannot start, that call raises the error."""
    with suppress(OSError):
        _children()[0].prepare()


def server_pid() -> int | None:
    """Return the number of the process that forks children; None while there is none."""
    return _children()[0].server_pid


def _children() -> tuple[ForkedProcesses, Slots]:
    with _guard:
        if not _shared or _shared[0][0] != os.getpid():
            _shared[:] = [(os.getpid(), ForkedProcesses(PREPARED, idle_s=IDLE_S), Slots(get_settings().decode_slots))]
        return _shared[0][1:]


# Fair sharing of a worker's compute slots between jobs.

_RECHECK_S = 0.2


@dataclass(eq=False)
class _Ticket:
    job_id: str
    number: int
    urgency: int


class Slots:
    """`count` slots. A free one goes to the most urgent job, then to the one with the fewest, then to the one served longest ago."""

    def __init__(self, count: int) -> None:
        self._free = count
        self._changed = threading.Condition()
        self._waiting: list[_Ticket] = []
        self._running: Counter[str] = Counter()
        self._served: dict[str, int] = {}
        self._clock = 0

    @contextmanager
    def hold(self, job_id: str, check: Callable[[], None], urgency: int = 0) -> Iterator[None]:
        """Wait for a slot and hold it; `check` is called while waiting and raises to give up."""
        with self._changed:
            self._clock += 1
            ticket = _Ticket(job_id, self._clock, urgency)
            self._waiting.append(ticket)
            try:
                while not (self._free and self._next() is ticket):
                    check()
                    self._changed.wait(_RECHECK_S)
                self._clock += 1
                self._free -= 1
                self._running[job_id] += 1
                self._served[job_id] = self._clock
            finally:
                self._waiting.remove(ticket)
                self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._free += 1
                self._running[job_id] -= 1
                if not self._running[job_id] and not any(t.job_id == job_id for t in self._waiting):
                    del self._running[job_id]
                    self._served.pop(job_id, None)
                self._changed.notify_all()

    def _next(self) -> _Ticket:
        return min(self._waiting, key=lambda t: (t.urgency, self._running[t.job_id], self._served.get(t.job_id, 0), t.number))
