"""Numba's `njit` with a cache on disk that several processes may fill at once, and that no read-only folder turns into an error."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache


class SharedCache(FunctionCache):
    """Numba's cache of one function, written by one process at a time.

    Numba reads an index, numbers the machine code of a function's signatures, then writes index and code one after the other without a
    lock. Two processes that compile different signatures at the same moment choose the same number. The index then names the code of the
    other signature, and later processes would run it on arguments of the wrong type.
    """

    def save_overload(self, sig: Any, data: Any) -> None:
        """Add the code of one signature; a cache that cannot be written any more (a full disk) is left as it is."""
        try:
            fd = os.open(Path(self.cache_path) / "betaloop.lock", os.O_RDWR | os.O_CREAT, 0o600)
        except OSError:
            return
        try:
            fcntl.flock(fd, fcntl.LOCK_EX)
            super().save_overload(sig, data)
        finally:
            os.close(fd)


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Make a decorator: `njit` with these options, cached on disk where the package's folder or the user's cache can be written.

    Where neither can be written, every process compiles again.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(**options)(function)
        with suppress(RuntimeError):  # numba found no folder that can be written
            dispatcher._cache = SharedCache(function)
        return dispatcher

    return decorate
