"""Errors of the structures beyond those that they state: constants from part A of the virtual population, never from B or C.

Variance of the error of a component = what the draws say + unit^2 (base^2 + reach^2 leverage), leverage from `ml.ope.posterior.support`.
Version 2 has the constants of least interval score of differences to cDBS over the 60 worlds of part A. Both designs count together, each
component by itself, and `COMMON_SHARE` that of absolute returns, rounded. Version 1 was set by hand from eleven of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.outcomes import PREDICTED

Floats = NDArray[np.float64]

VERSION = 2
"""Raised with every refit; an estimate keeps it."""


@dataclass(frozen=True)
class ModelError:
    """Standard deviation of what structures get wrong. base: near the data. reach: more, where no session is near."""

    base: float
    reach: float

    def sd(self, leverage: float) -> float:
        """Compute the standard deviation at a leverage in [0, 1]."""
        return float((self.base**2 + self.reach**2 * leverage) ** 0.5)


MODEL_ERRORS = {
    "steps": ModelError(0.0135, 0.03),
} | {o.field: ModelError(*p.model_error) for o, p in PREDICTED}
"""By component, in the units of `error_unit`."""

LEAST_POINTS = 0.2
"""Percentage points: the least unit of an error of a share of the minutes, for participants who never have them."""

_OF_MINUTES = frozenset(o.field for o, p in PREDICTED if p.kind == "binomial")

COMMON_SHARE = 0.6
"""Share of the error of a mean over few days, common to all policies, that is drawn. Its prior of the differences between days is too
wide."""


def error_unit(component: str, expected: Floats, reach: float) -> Floats:
    """Compute the unit of what structures get wrong, [P].

    A share of time that is nearly 0 or 1 can hardly be wrong by ten points. Its error is one of its logit, and moves the share p by p (1 -
    p) of that.

    Args:
        component: of `MODEL_ERRORS`. expected: mean of each policy, natural unit, [P].
        reach: reward between r_b and r_a times the discounted length.
    """
    if component == "steps":
        return np.full(expected.shape, reach)
    if component in _OF_MINUTES:
        share = np.clip(expected / 100.0, 0.0, 1.0)
        return np.asarray(np.maximum(100.0 * share * (1 - share), LEAST_POINTS), dtype=np.float64)
    return np.ones(expected.shape)
