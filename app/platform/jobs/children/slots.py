"""Fair sharing of a worker's compute slots between jobs."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

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
