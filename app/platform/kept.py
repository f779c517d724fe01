"""Results that this process keeps under a key that names everything they depend on."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Sequence
from threading import Lock
from typing import Any, TypeVar, cast

T = TypeVar("T")

KEPT = 512
"""Results that a process keeps; the oldest goes first."""

KEPT_SUMMARIES = 20_000
"""Small results, of some kilobytes, that it keeps apart from them: a page of all participants needs several of each."""

_kept: OrderedDict[Hashable, Any] = OrderedDict()
_summaries: OrderedDict[Hashable, Any] = OrderedDict()
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


def summaries(keys: Sequence[Hashable], compute: Callable[[Sequence[int]], Iterable[T]]) -> list[T]:
    """Return small results under keys that name everything they depend on.

    Args:
        compute: gives those that this process has not cached, in order, for their places in `keys`.
    """
    with _lock:
        found = {i: _summaries[key] for i, key in enumerate(keys) if key in _summaries}
        for i in found:
            _summaries.move_to_end(keys[i])
    lacking = [i for i in range(len(keys)) if i not in found]
    for i, result in zip(lacking, compute(lacking) if lacking else (), strict=True):
        found[i] = result
        with _lock:
            _summaries[keys[i]] = result
            while len(_summaries) > KEPT_SUMMARIES:
                _summaries.popitem(last=False)
    return [found[i] for i in range(len(keys))]


def forget() -> None:
    """Drop everything that is kept: for measuring."""
    with _lock:
        _kept.clear()
        _summaries.clear()
