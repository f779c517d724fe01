"""Results that this process keeps under a key that names everything they depend on."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Any, TypeVar, cast

T = TypeVar("T")

KEPT = 512
"""Results that a process keeps; the oldest goes first."""

_kept: OrderedDict[Hashable, Any] = OrderedDict()
_lock = Lock()


def kept(key: Hashable, compute: Callable[[], T]) -> T:
    """Return a result under a key that names everything it depends on; compute it where this process has not cached it."""
    known = recalled(key)
    return keep(key, compute()) if known is None else cast("T", known)


def keep(key: Hashable, result: T) -> T:
    """Keep a result under a key that names everything it depends on; returns it."""
    with _lock:
        _kept[key] = result
        while len(_kept) > KEPT:
            _kept.popitem(last=False)
    return result


def recalled(key: Hashable) -> Any:
    """Return the result that this process has cached under a key, or None."""
    with _lock:
        if key in _kept:
            _kept.move_to_end(key)
        return _kept.get(key)


def forget() -> None:
    """Drop everything that is kept: for measuring."""
    with _lock:
        _kept.clear()
