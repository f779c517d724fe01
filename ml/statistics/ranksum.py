"""Wilcoxon rank-sum (Mann-Whitney) test of one controller's sessions against another's, as in the paper's results (section 6.1).

Sources: Mann and Whitney 1947 (the recursion of the exact distribution), Hodges and Lehmann 1963 (the shift and its interval).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from ml.statistics.within_visits.contrasts import Measurements, Unavailable

EXACT_UP_TO = 2500
"""Exact p-values while n_x * n_y stays at or below this; beyond it the normal approximation is good to more digits than are shown."""

ROUNDING = 1e-12
"""Relative rounding of a sum of probabilities."""


@dataclass(frozen=True)
class RankSum:
    """Result of a two-sided rank-sum test.

    Attributes:
        u: Mann-Whitney U of x: pairs with x > y, ties counting one half.
        p_value: two-sided: twice the smaller tail. Where ties meet groups of unequal size R's `coin` has another one, the chance of all
            outcomes that lie as far from the mean.
        method: `exact` (given the ties, where there are any), or `normal approximation` (with tie and continuity correction).
        n_x, n_y: sessions on either side.
        median_x, median_y: medians.
        shift: Hodges-Lehmann estimate of x - y, in the unit of the measurements.
        low, high: its interval; its actual coverage is at least `level` where the method is exact. None where so few sessions cannot have
            one of that level: even from the smallest difference of a pair to the largest it would cover less.
        level: coverage aimed at.
        superiority: share of pairs with x > y (ties one half), U / (n_x n_y).
    """

    u: float
    p_value: float
    method: str
    n_x: int
    n_y: int
    median_x: float
    median_y: float
    shift: float
    low: float | None
    high: float | None
    level: float
    superiority: float


def rank_sum(x: ArrayLike, y: ArrayLike, level: float = 0.95) -> RankSum:
    """Test two groups of sessions by the two-sided Wilcoxon rank-sum test, and estimate the Hodges-Lehmann shift between them.

    Args:
        x: one value per session of the first controller, shape [n_x], finite.
        y: the same of the second, shape [n_y].
        level: coverage of the interval of the shift.

    Raises:
        ValueError: an empty group, a value that is not finite, or a level outside (0, 1).
    """
    x, y = _group(x, "first"), _group(y, "second")
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval must be between 0 and 1, not {level}")
    u = _u(x, y)
    exact = _is_exact(x, y)
    null = _null(x, y) if exact else None
    upper = _tail(x, y, u, null)
    lower = _tail(y, x, x.size * y.size - u, _null(y, x) if exact else None)
    differences = np.sort(np.subtract.outer(x, y).ravel())
    low, high = _shift_interval(x.size, y.size, differences, level) or (None, None)
    return RankSum(
        u=u,
        p_value=min(1.0, 2 * min(upper, lower)),
        method="exact" if exact else "normal approximation",
        n_x=x.size,
        n_y=y.size,
        median_x=float(np.median(x)),
        median_y=float(np.median(y)),
        shift=float(np.median(differences)),
        low=low,
        high=high,
        level=level,
        superiority=u / (x.size * y.size),
    )


def as_in_the_paper(data: Measurements, level: float = 0.95) -> RankSum | Unavailable:
    """Run the paper's test: all sessions of a controller against all of cDBS, whatever their visit.

    Returns:
        The test of the sessions that have a value, or that one of the arms has none.
    """
    known = np.isfinite(data.value)
    x, y = data.value[known & data.tested], data.value[known & ~data.tested]
    if not x.size or not y.size:
        return data.no_evidence()
    return rank_sum(x, y, level)


def p_greater(x: ArrayLike, y: ArrayLike) -> float:
    """Compute the one-sided p-value of the rank-sum test that x tends to be larger than y.

    Raises:
        ValueError: a group `rank_sum` would refuse.
    """
    x, y = _group(x, "first"), _group(y, "second")
    return _tail(x, y, _u(x, y), _null(x, y) if _is_exact(x, y) else None)


@lru_cache(maxsize=256)
def u_distribution(n_x: int, n_y: int) -> NDArray[np.float64]:
    """Compute the exact probabilities of U = 0 ... n_x n_y without ties, shape [n_x n_y + 1].

    The number of rankings with U = u is the coefficient of q^u in the Gaussian binomial coefficient, the product over
    i = 1 ... n_x of (1 - q^(n_y + i)) / (1 - q^i).
    """
    size = n_x * n_y + 1
    counts = np.zeros(size)
    counts[0] = 1.0
    for i in range(1, n_x + 1):
        top = n_y + i
        if top < size:
            counts[top:] = counts[top:] - counts[: size - top].copy()
        for start in range(i):  # division by (1 - q^i) is a cumulative sum with stride i
            counts[start::i] = np.cumsum(counts[start::i])
        counts /= counts.max()  # probabilities are wanted, and counts outgrow a float
    probabilities = counts / counts.sum()
    probabilities.flags.writeable = False
    return probabilities


def _group(values: ArrayLike, which: str) -> NDArray[np.float64]:
    group = np.asarray(values, dtype=np.float64).ravel()
    if group.size == 0:
        raise ValueError(f"the {which} group has no session: a rank-sum test needs at least one on each side")
    if not np.isfinite(group).all():
        raise ValueError(f"the {which} group holds a value that is not a number; leave sessions without a measurement out")
    return group


def _u(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    return float(np.sum(x[:, None] > y) + 0.5 * np.sum(x[:, None] == y))


def _is_exact(x: NDArray[np.float64], y: NDArray[np.float64]) -> bool:
    return x.size * y.size <= EXACT_UP_TO


def _null(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the exact probabilities of 2 U = 0 ... 2 n_x n_y, given which values are tied; shape [2 n_x n_y + 1]."""
    sizes = np.unique(np.concatenate([x, y]), return_counts=True)[1]
    if sizes.max() > 1:
        return u_distribution_given_ties(x.size, tuple(sizes.tolist()))
    doubled = np.zeros(2 * x.size * y.size + 1)
    doubled[::2] = u_distribution(x.size, y.size)
    return doubled


@lru_cache(maxsize=256)
def u_distribution_given_ties(n_x: int, sizes: tuple[int, ...]) -> NDArray[np.float64]:
    """Compute the exact probabilities of 2 U given the ties: every choice of n_x of the pooled mid-ranks is equally likely.

    Args:
        n_x: values of the first group.
        sizes: how many pooled values are equal, from the smallest value to the largest; they sum to n_x + n_y.

    Returns:
        Probabilities of 2 U = 0 ... 2 n_x n_y, shape [2 n_x n_y + 1]. Doubled, because tied values have ranks of one half.
    """
    n = sum(sizes)
    if 2 * n_x > n:  # the smaller group makes the smaller table: what one group wins the other loses
        return u_distribution_given_ties(n - n_x, sizes)[::-1]
    # The rank sum is at least that of the lowest ranks, and no more than 2 n for each value (doubled).
    counts = np.zeros((n_x + 1, 2 * n * n_x + 1))
    counts[0, 0] = 1.0
    below = 0
    for size in sizes:
        doubled_rank = 2 * below + size + 1
        for _ in range(size):
            # choose the value or not; from the largest choice down, so that none is chosen twice
            counts[1:, doubled_rank:] += counts[:-1, :-doubled_rank].copy()
        below += size
    start = n_x * (n_x + 1)  # 2 U is twice the rank sum less this
    chosen = counts[n_x, start : start + 2 * n_x * (n - n_x) + 1]
    probabilities = chosen / chosen.sum()
    probabilities.flags.writeable = False
    return probabilities


def _standard_deviation(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Compute the standard deviation of U under the null hypothesis, with the correction for ties."""
    n = x.size + y.size
    ties = np.unique(np.concatenate([x, y]), return_counts=True)[1].astype(np.float64)
    correction = float(np.sum(ties**3 - ties)) / (n * (n - 1)) if n > 1 else 0.0
    return float(np.sqrt(x.size * y.size / 12 * (n + 1 - correction)))


def _tail(x: NDArray[np.float64], y: NDArray[np.float64], u: float, null: NDArray[np.float64] | None) -> float:
    """Compute P(U >= u) under the null hypothesis, by its exact distribution where there is one."""
    if null is not None:
        return float(min(1.0, null[round(2 * u) :].sum()))
    sd = _standard_deviation(x, y)
    if sd == 0:
        return 1.0
    return float(ndtr(-(u - x.size * y.size / 2 - 0.5) / sd))


def _shift_interval(n_x: int, n_y: int, differences: NDArray[np.float64], level: float) -> tuple[float, float] | None:
    """Bound the shift by the k-th smallest and largest of the pairwise differences, sorted; None where no k has the level.

    k is that of the distribution without ties. With ties the interval, its ends included, covers at least as often (Lehmann 1963).
    """
    tail = (1 - level) / 2
    if n_x * n_y <= EXACT_UP_TO:
        k = int(np.searchsorted(np.cumsum(u_distribution(n_x, n_y)), tail * (1 + ROUNDING), side="right"))
    else:
        k = int(np.floor(n_x * n_y / 2 + float(ndtri(tail)) * np.sqrt(n_x * n_y * (n_x + n_y + 1) / 12)))
        if k < 1 and 1 / comb(n_x + n_y, n_x) <= tail:
            k = 1  # the approximation knows no end of the distribution
    k = min(k, (differences.size + 1) // 2)
    return (float(differences[k - 1]), float(differences[-k])) if k >= 1 else None
