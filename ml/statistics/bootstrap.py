"""Bootstraps whose unit is the session, so that steps of one session never count as independent.

Source: Efron and Tibshirani, An Introduction to the Bootstrap, chapters 13 (percentile) and 14 (BCa).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Interval:
    """A two-sided interval and what it was made from.

    Attributes:
        low, high: ends, in the unit of the statistic.
        level: coverage aimed at, such as 0.90.
        standard_error: standard deviation of the bootstrap draws.
        method: `percentile` or `bca`.
    """

    low: float
    high: float
    level: float
    standard_error: float
    method: str


def resamples(n: int, draws: int, seed: int) -> Indices:
    """Draw session indices with replacement, shape [draws, n]; the same seed gives the same resamples for every policy.

    Raises:
        ValueError: no session or no draw.
    """
    if n < 1 or draws < 1:
        raise ValueError(f"a bootstrap needs at least one session and one draw, not {n} and {draws}")
    return np.random.default_rng(seed).integers(0, n, size=(draws, n))


def resampled(n: int, seed: int) -> str:
    """Name the `resamples` of n sessions with a seed: equal names mean equal resamples, as far as both go."""
    return f"{n} sessions, seed {seed}"


def session_bootstrap(
    statistic: Callable[[Indices], float],
    n: int,
    *,
    level: float = 0.90,
    draws: int = 1000,
    seed: int = 0,
    method: Literal["percentile", "bca"] = "percentile",
) -> Interval:
    """Estimate the interval of a statistic of n sessions.

    Args:
        statistic: value for a list of session indices, shape [n] (or [n - 1] in the jackknife of BCa), repeats allowed.
        n: number of sessions.
        level: coverage, between 0 and 1.
        draws: number of resamples.
        seed: seed of the resamples.
        method: `percentile`, or `bca` (bias-corrected and accelerated; needs at least 3 sessions).

    Raises:
        ValueError: a level outside (0, 1), draws that are not finite, or fewer than 3 sessions for BCa.
    """
    values = np.array([statistic(index) for index in resamples(n, draws, seed)])
    if method == "percentile":
        return percentile_interval(values, level)
    if n < 3:
        raise ValueError(f"a BCa interval needs at least 3 sessions, not {n}")
    everything = np.arange(n)
    jackknife = np.array([statistic(np.delete(everything, i)) for i in range(n)])
    return bca_interval(values, statistic(everything), jackknife, level)


def percentile_interval(values: NDArray[Any], level: float) -> Interval:
    """Compute the percentile interval of bootstrap draws, shape [draws]. Raises ValueError as `bca_interval` does."""
    _check(level, values)
    tail = (1 - level) / 2
    low, high = _quantiles(values, [tail, 1 - tail])
    return Interval(float(low), float(high), level, _spread(values), "percentile")


def bca_interval(values: NDArray[Any], estimate: float, jackknife: NDArray[Any], level: float) -> Interval:
    """Compute the bias-corrected and accelerated interval (Efron and Tibshirani, eq. 14.9-14.15).

    Args:
        values: bootstrap draws, shape [draws].
        estimate: the statistic of the sessions as they are.
        jackknife: the statistic without one session at a time, shape [n].
        level: coverage, between 0 and 1.

    Returns:
        The interval. Where bias and acceleration are so large that the correction reverses its direction (1 - a z <= 0 in eq. 14.10), it is
        the percentile interval, and its `method` says so.

    Raises:
        ValueError: a level outside (0, 1), or values that are not finite.
    """
    _check(level, values, jackknife, np.array([estimate]))
    # Half of the ties count, so that a discrete statistic is not taken for a biased one.
    share = (np.sum(values < estimate) + 0.5 * np.sum(values == estimate)) / values.size
    share = float(np.clip(share, 0.5 / values.size, 1 - 0.5 / values.size))
    bias = float(ndtri(share))
    # The acceleration has no unit: values near the largest number are scaled down before their powers are taken.
    scaled, _ = _scale_down(jackknife)
    centred = scaled.mean() - scaled
    spread = float(np.sum(centred**2) ** 1.5)
    acceleration = float(np.sum(centred**3) / (6 * spread)) if spread > 0 else 0.0
    ends = []
    for tail in ((1 - level) / 2, (1 + level) / 2):
        z = bias + float(ndtri(tail))
        if acceleration * z >= 1:
            return percentile_interval(values, level)
        ends.append(float(ndtr(bias + z / (1 - acceleration * z))))
    low, high = _quantiles(values, ends)
    return Interval(float(low), float(high), level, _spread(values), "bca")


def _spread(values: NDArray[Any]) -> float:
    scaled, factor = _scale_down(values)
    return float(np.std(scaled, ddof=1)) * factor if values.size > 1 else 0.0


def _quantiles(values: NDArray[Any], shares: list[float]) -> Floats:
    scaled, factor = _scale_down(values)
    return np.asarray(np.quantile(scaled, shares) * factor)


def _scale_down(values: NDArray[Any]) -> tuple[Floats, float]:
    """Scale values to at most 2, so that neither sums nor squares overflow; also return the power of two that they were divided by."""
    exponent = min(int(np.frexp(np.abs(values).max(initial=0.0))[1]), 1023)
    return np.ldexp(np.asarray(values, dtype=np.float64), -exponent), float(np.ldexp(1.0, exponent))


def _check(level: float, *numbers: NDArray[Any]) -> None:
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval must be between 0 and 1, not {level}")
    if not all(np.isfinite(n).all() for n in numbers):
        raise ValueError("an interval needs finite values: an estimate of some resample is infinite or not a number")
