"""Sessions that a member of the ensemble learns from, and those held out of it."""

from __future__ import annotations

import numpy as np

from ml.ope.scale import session_folds
from ml.trajectories import ReplayBuffer

FEWEST_HELD = 2
"""Sessions that a resampled member must not have learnt from."""


def usable_folds(buffer: ReplayBuffer, share: float, seed: int) -> list[list[int]]:
    """Group the indices of the sessions with a usable step, about `share` of them in each of at least two groups."""
    usable = [i for i, s in enumerate(buffer.sessions) if s.usable().any()]
    folds = session_folds([buffer.sessions[i] for i in usable], max(2, round(1 / share)), seed)
    return [[usable[k] for k in fold] for fold in folds]


def resampled(buffer: ReplayBuffer, seed: int) -> tuple[list[int], list[int]]:
    """Draw indices of sessions with replacement, as many as are usable; return them and those that were not drawn."""
    usable = [i for i, s in enumerate(buffer.sessions) if s.usable().any()]
    rng = np.random.default_rng([seed, 0xB007])
    while True:
        drawn = sorted(int(i) for i in rng.choice(usable, len(usable)))
        held = [i for i in usable if i not in set(drawn)]
        if len(held) >= FEWEST_HELD and len(set(drawn)) >= FEWEST_HELD:
            return drawn, held
