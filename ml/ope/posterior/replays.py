"""What the structures replay, which estimates, evidence and support are made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Replays:
    """Sessions under policies in all structures: P policies, D draws, n sessions.

    Attributes:
        step_return, energy, amplitude, beta: [P, D, n]. outcomes: [P, D, n, 4]. weights: of the draws, [D], summing to 1.
        summaries: `support.SUMMARIES` of each policy, [P, 4]. behaviour: see `FittedPosterior`, by policy.
    """

    step_return: Floats
    energy: Floats
    amplitude: Floats
    beta: Floats
    outcomes: Floats
    weights: Floats
    summaries: Floats
    behaviour: tuple[dict[str, float], ...]
