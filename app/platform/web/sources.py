"""Limits of one source in a span of time: failed sign-ins per network address, bytes of files per address or user; limits of costly work.

Kept in the memory of one process: several web processes each count for themselves, and a restart forgets.
"""

from __future__ import annotations

import ipaddress
import math
import threading
import time
from collections.abc import Callable
from typing import TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi import Request

from app.platform.errors import TooMany
from app.platform.numbers import counted

MOST_SOURCES = 10_000
"""Sources that are remembered; beyond them those that have asked for the least are forgotten."""


class Allowance:
    """Allowance of every source; it comes back evenly over the span.

    Args:
        most: what a source may use up at once, read at each use (a setting).
        span_s: seconds after which all of it has come back.
        clock: seconds.
    """

    def __init__(self, most: Callable[[], float], span_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._span_s, self._clock = most, span_s, clock
        self._used: dict[str, tuple[float, float]] = {}
        self._lock = threading.Lock()

    def take(self, source: str, amount: float = 1.0) -> int:
        """Use up an amount: 0 where it is allowed, else (nothing is used up) the whole seconds after which it will be.

        More than a source ever has is allowed to one that has used up nothing.
        """
        with self._lock:
            most, present = self._most(), self._clock()
            used = self._left_over(source, most, present)
            beyond = used + min(amount, most) - most
            if beyond > 0:
                return math.ceil(beyond * self._span_s / most)
            self._used[source] = (used + amount, present)
            if len(self._used) > MOST_SOURCES:
                self._forget_small(most, present)
            return 0

    def give_back(self, source: str, amount: float = 1.0) -> None:
        """Undo a use."""
        with self._lock:
            present = self._clock()
            self._used[source] = (max(self._left_over(source, self._most(), present) - amount, 0.0), present)

    def forget(self) -> None:
        """Reset the allowance of every source."""
        with self._lock:
            self._used.clear()

    def _left_over(self, source: str, most: float, present: float) -> float:
        used, at = self._used.get(source, (0.0, present))
        return max(used - (present - at) * most / self._span_s, 0.0)

    def _forget_small(self, most: float, present: float) -> None:
        by_use = sorted(self._used, key=lambda source: self._left_over(source, most, present))
        for source in by_use[: MOST_SOURCES // 10]:
            del self._used[source]


def network_address(request: Request) -> str:
    """Return the address of a request; behind a proxy that uvicorn trusts (FORWARDED_ALLOW_IPS) the address that the proxy names."""
    return request.client.host if request.client else "unknown"


def from_this_machine(request: Request) -> bool:
    """Decide whether a request comes from this machine and no proxy has passed it on."""
    if any(name in request.headers for name in ("forwarded", "x-forwarded-for", "x-real-ip", "via")):
        return False
    try:
        return ipaddress.ip_address(network_address(request)).is_loopback
    except ValueError:
        return False


def in_words(seconds: int) -> str:
    """Format a wait for people."""
    if seconds < 90:
        return counted(seconds, "second")
    return f"{math.ceil(seconds / 60)} minutes"


# Costly work of requests in threads of its own, a few at a time, so that many such requests at once hold up nothing else.

Result = TypeVar("Result")


class Bounded:
    """Runs functions in threads.

    Args:
        at_once: how many run side by side.
        most_waiting: how many more may wait for their turn.
    """

    def __init__(self, at_once: int, most_waiting: int) -> None:
        self._limiter = CapacityLimiter(at_once)
        self.most = at_once + most_waiting
        self._present = 0  # changed by the event loop's thread alone

    async def run(self, work: Callable[..., Result], *arguments: object) -> Result:
        """Run `work(*arguments)` and return its result.

        Raises:
            TooMany: as many wait already as may.
        """
        if self._present >= self.most:
            raise TooMany("Too many people ask for this at the same moment.", "Wait a few seconds and try again.")
        self._present += 1
        try:
            return await to_thread.run_sync(work, *arguments, limiter=self._limiter)
        finally:
            self._present -= 1
