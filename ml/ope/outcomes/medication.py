"""Wearing off of medication at a session, by the time since the last dose. Outcomes are adjusted for it, and no policy moves it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

WORN_OFF_H: Final = {"worn early": 2.0, "worn late": 3.5}
"""Hours after which half of the effect of a dose is gone, by column. A single dose of levodopa works for two to four hours (our choice)."""

WIDTH_H: Final = 0.4
"""Width of the logistic by which it goes."""

FEWEST_KNOWN: Final = 6
"""Sessions with a known time below which nothing is adjusted for it."""

LEAST_SPREAD: Final = 0.05
"""Standard deviation of a column between sessions below which it is ignored."""


def worn_off(buffer: ReplayBuffer) -> dict[str, Floats]:
    """Compute columns of every session by name, [n], less their mean over sessions with a known time; 0, which is that mean, for the
    others.

    Sessions of one visit differ by it, and what is given late in a visit is not what makes symptoms come back.
    Empty where fewer than `FEWEST_KNOWN` sessions, or less than half of them, know it.
    """
    hours = np.array([np.nan if s.medication_h is None else s.medication_h for s in buffer.sessions])
    known = np.isfinite(hours)
    if known.sum() < max(FEWEST_KNOWN, known.size / 2):
        return {}
    result = {}
    for name, half in WORN_OFF_H.items():
        worn = 1 / (1 + np.exp(-(hours - half) / WIDTH_H))
        column = np.where(known, worn - worn[known].mean(), 0.0)
        if column[known].std() >= LEAST_SPREAD:
            result[name] = column
    return result
