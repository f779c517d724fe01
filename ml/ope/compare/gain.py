"""Gain of one policy over another by one method: what both share cancels."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

from ml.ope.compare.skill import reach_with
from ml.ope.estimate import Estimate
from ml.returns import FEWEST_DRAWS, Gain, gain


def gain_over(policy: Estimate, reference: Estimate) -> Gain:
    """Compute the difference of two estimates of one method: over their aligned draws, in which what both share cancels, where both kept
    them.

    The interval is widened by the method's error of differences between controllers that it had not seen, where that is known.
    """
    value = policy.value - reference.value
    unseen = float(policy.details.get("held_out_difference_error", 0.0))
    ours, theirs = (np.asarray(e.details.get("draws") or [], dtype=np.float64) for e in (policy, reference))
    tail = (1 - policy.level) / 2
    if ours.size == theirs.size >= FEWEST_DRAWS:
        drawn = gain(ours, theirs, 1 - tail)
        below, above = max(drawn.value - drawn.low, 0.0), max(drawn.high - drawn.value, 0.0)
        error = math.hypot(drawn.standard_error, unseen)
        return Gain(value, value - reach_with(below, unseen), error, value + reach_with(above, unseen), policy.level)
    errors = [math.sqrt(max(0.0, e.standard_error**2 - e.details.get("held_out_error", 0.0) ** 2)) for e in (policy, reference)]
    reach = reach_with(float(ndtri(1 - tail)) * math.hypot(*errors), unseen)
    return Gain(value, value - reach, math.hypot(*errors, unseen), value + reach, policy.level)
