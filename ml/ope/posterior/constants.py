"""Constants of the posterior that are set by hand; `benchmarks/posterior_constants.py` makes the learned ones (`learned/constants.npz`).

`FALLBACK` is what structures get wrong where a record is unlike all that constants were learned from. Variance = what the draws say +
base^2 + reach^2 leverage, leverage from `ml.ope.posterior.support`. It was set by hand on eleven worlds of part A of the virtual
population.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

VERSION = 2
"""Raised with every refit of the learned constants, which keep it too; an estimate keeps it."""


@dataclass(frozen=True)
class ModelError:
    """Standard deviation of what structures get wrong. base: near the data. reach: more, where no session is near."""

    base: float
    reach: float

    def variance(self, leverage: Floats) -> Floats:
        """At leverages in [0, 1]."""
        return np.asarray(self.base**2 + self.reach**2 * leverage, dtype=np.float64)


FALLBACK = {
    "steps": ModelError(0.025, 0.05),
    "grasp_hz": ModelError(0.04, 0.06),
    "rating": ModelError(0.2, 0.35),
    "tremor_percent": ModelError(5.0, 6.0),
}
"""By quantity. `steps`: per unit of the reward between r_b and r_a and of the discounted length; the others in their own unit."""

BELIEVED = 0.6
"""Share of a learned correction that is taken; how far it is from none widens the interval. No population is a patient's own: on part A all
of it orders better (rank correlation 0.72 with stratified sessions, 0.70 so), on simulators of other equations a share errs less."""

COMMON_SHARE = 0.5
"""Share of the error of a mean over few days, common to all policies, that is drawn: its prior of how days differ is wider than they do."""
