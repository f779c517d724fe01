"""Which of several policies to prefer, if any, from estimates alone: by the lower bound of the gain over a reference, such as cDBS.

The best of several noisy estimates is the luckiest as much as the best. Two things keep luck out. Draws of one method share their
resampled sessions over all policies, so what a good day adds to every policy cancels in a difference; and the bound, not the estimate, is
compared, so that a policy of which the data say little does not win by what they leave open. Lower bounds as the criterion of deployment:
Thomas, Theocharous and Ghavamzadeh, AAAI 2015. Where no bound lies above the reference, nothing is chosen.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ml.policies.policy import Policy
from ml.returns import BOUND, Gain, gain


def surest(gains: Mapping[str, Gain]) -> str | None:
    """Name of the policy with the largest lower bound of its gain over the reference; None where no bound lies above 0.

    Each bound stands for itself: the best of many bounds is above 0 by luck more often than one.
    """
    best = max(gains, key=lambda name: gains[name].low, default=None)
    return best if best is not None and gains[best].low > 0 else None


class Drawn(Protocol):
    """An estimate whose `details` hold aligned bootstrap draws of the return as `draws`."""

    @property
    def details(self) -> Mapping[str, Any]: ...


class Evaluator(Protocol):
    """A fitted method of off-policy evaluation whose draws of all policies rest on the same resampled sessions."""

    def evaluate(self, policies: Mapping[str, Policy]) -> Mapping[str, Drawn]: ...


def gains_over(fitted: Evaluator, policies: Mapping[str, Policy], reference: Policy, level: float = BOUND) -> dict[str, Gain]:
    """Gain of every policy over the reference, by name. Raises ValueError where the method cannot evaluate or gives too few draws."""
    theirs = _draws(fitted, reference)
    return {name: gain(_draws(fitted, policy), theirs, level) for name, policy in policies.items()}


def _draws(fitted: Evaluator, policy: Policy) -> NDArray[np.float64]:
    return np.asarray(fitted.evaluate({"policy": policy})["policy"].details["draws"], dtype=np.float64)
