"""Costly work of requests in threads of its own, a few at a time, so that many such requests at once hold up nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from anyio import CapacityLimiter, to_thread

from app.platform.errors import TooMany

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
