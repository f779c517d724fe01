"""Counters of devices that turn: the one function that lets them run on.

The facts of each format list its counters (`ml/formats/facts`). Where two series of one device count differently, one running on and one
turning, `shift_by_turns` finds the whole turns between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Counter:
    """One counter of a device.

    Attributes:
        turn: value at which it restarts, in units of the field. unit: of one count.
        always: whether it restarts in every file; else it runs on in some.
        source: of the fact.
    """

    turn: float
    unit: str
    always: bool
    source: str


def unwrap(values: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """Extend a counter so that it continues where it restarted: every fall by more than half a turn is one turn.

    Args:
        values: in the order in which they were counted, [n]. A smaller fall is a value out of order and stays.
        turn: of the counter.
    """
    turns = np.concatenate(([0], np.cumsum(np.diff(values) < -turn / 2)))
    return np.asarray(values + turn * turns[: values.size], dtype=np.float64)


def shift_by_turns(value: float, target: float, turn: float) -> float:
    """Compute the whole turns to add to `value` so that it is nearest to `target`; a multiple of `turn`."""
    return turn * float(np.round((target - value) / turn))
