"""Controllers made from a buffer without learning, that a trained policy has to beat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ml.policies.policy import ConstantPolicy, ProportionalPolicy, Score
from ml.trajectories import ReplayBuffer


def behaviour_mean(buffer: ReplayBuffer) -> ConstantPolicy:
    """Build the constant policy of the mean amplitude fraction over the buffer's usable steps: the logged energy without its variation."""
    return ConstantPolicy(float(buffer.transitions().actions.mean()))


CONSTANT_GRID = tuple(round(0.3 + 0.05 * k, 2) for k in range(15))
"""Amplitude fractions from 0.30 to 1.00 tried by `best_constant`."""


@dataclass(frozen=True)
class ConstantChoice:
    """The constant amplitude that the data prefer, and the estimate of every one that was tried.

    Attributes:
        policy: the constant with the largest estimate; of equals the smallest amplitude.
        estimates: by amplitude fraction.
    """

    policy: ConstantPolicy
    estimates: Mapping[float, float]


def best_constant(score: Score, amplitudes: Sequence[float] = CONSTANT_GRID) -> ConstantChoice:
    """Choose the best constant amplitude by an estimate from data.

    Args:
        score: estimate of a policy's value from held-out sessions of the estimator's fit (fitted Q evaluation, for example).
        amplitudes: fractions to try. Outside the logged range an estimate is extrapolation.

    Raises:
        ValueError: no amplitude, one outside [0, 1], or an estimate that is not finite.
    """
    estimates = {float(a): float(score(ConstantPolicy(a))) for a in sorted(amplitudes)}
    if not estimates:
        raise ValueError("choosing a constant amplitude needs one or more to try")
    wrong = [a for a, value in estimates.items() if not np.isfinite(value)]
    if wrong:
        raise ValueError(f"the estimate of a constant amplitude of {wrong[0]:g} is not finite")
    return ConstantChoice(ConstantPolicy(max(estimates, key=estimates.__getitem__)), estimates)


def proportional_from_buffer(
    buffer: ReplayBuffer, low_quantile: float = 0.25, high_quantile: float = 0.9, floor: float = 0.0, newest: int = 1
) -> ProportionalPolicy:
    """Build proportional control between two quantiles of the participant's own beta amplitudes.

    Args:
        buffer: sessions of the participant.
        low_quantile: share of the beta amplitudes below the level at which the amplitude starts to rise from `floor`.
        high_quantile: share below the level from which the amplitude is 1.
        floor: lowest amplitude fraction.
        newest: how many of the newest beta amplitudes are averaged.

    Raises:
        ValueError: quantiles out of order or outside [0, 1], or a beta trace without spread between them.
    """
    if not 0 <= low_quantile < high_quantile <= 1:
        raise ValueError(f"the quantiles must rise within [0, 1], not {low_quantile} and {high_quantile}")
    beta = np.concatenate([session.measured_beta for session in buffer.sessions])
    low, high = (float(q) for q in np.nanquantile(beta, [low_quantile, high_quantile]))
    if low >= high:
        raise ValueError(
            f"beta has no spread between its quantiles {low_quantile} and {high_quantile} (both {low:.4g}): nothing to be proportional to"
        )
    return ProportionalPolicy(low, high, floor, newest)
