"""Exact rank tests that shuffle sessions within visits alone: did the controller differ from cDBS on these visits at all?

The hypothesis: no session of any visit would have had another value under the other arm. Then every way to divide a visit's values between
its arms is equally likely. The distribution of the statistic is computed by convolution over visits, not by enumeration. Where effects
differ in sign between visits, that hypothesis is false although the average may be zero: `visits.py` tests the average.

Sources: van Elteren 1960 (the weighted sum of Wilcoxon statistics of strata), Hodges and Lehmann 1962 (aligned ranks). Hodges and Lehmann
1963 (the interval by inversion). Besag and Clifford 1991, Phipson and Smyth 2010 (the p-value of a random sample of shufflings).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache, reduce
from math import gcd

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from ml.statistics.ranksum import u_distribution, u_distribution_given_ties
from ml.statistics.within_visits.contrasts import Measurements, Unavailable

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

LARGEST_LATTICE = 1 << 20
"""Points of the exact distribution; beyond them, or beyond `LARGEST_TABLE`, shufflings are drawn at random."""

LARGEST_TABLE = 3e8
"""Additions that the exact distribution of one visit may cost."""

DRAWS = 9999
WEIGHT_STEPS = 16
"""The weight of the largest visit in whole steps: weights are rounded to steps so that the distribution lives on a lattice."""

ROUNDING = 1e-9
"""Probabilities from a Fourier transform carry errors near 1e-16; tails are compared with a level no finer than this."""


class Method(StrEnum):
    """Method by which a p-value was computed."""

    EXACT = "exact"
    MONTE_CARLO = "monte_carlo"


@dataclass(frozen=True)
class StratifiedTest:
    """A test that shuffles within visits.

    Attributes:
        p_value: two-sided, twice the smaller tail. p_greater, p_less: one-sided, that the controller's values are higher or lower.
        statistic: weighted sum over visits of 2 U (van Elteren) or of the doubled aligned ranks of the controller's sessions.
        expected: its mean under the hypothesis.
        method: exact, or from `draws` random shufflings (0 where exact). visits, n_tested, n_cdbs: what was tested.
    """

    p_value: float
    p_greater: float
    p_less: float
    statistic: float
    expected: float
    method: Method
    draws: int
    visits: int
    n_tested: int
    n_cdbs: int


@dataclass(frozen=True)
class ShiftInterval:
    """A shift that is the same at every visit, with the interval of all shifts that van Elteren's test does not reject.

    Attributes:
        estimate: median of the differences of all pairs within visits, each weighted as in the test (Hodges-Lehmann).
        low, high: -inf or inf where the sessions are too few for an end.
        level: coverage aimed at; the actual coverage is at least this, ties or not.
    """

    estimate: float
    low: float
    high: float
    level: float
    method: Method


def van_elteren(data: Measurements, *, seed: int = 0) -> StratifiedTest | Unavailable:
    """Run van Elteren's test: Wilcoxon statistics of the visits, each weighted by 1 / (sessions + 1).

    Args:
        data: sessions of both arms; those without a value are excluded, and so is every visit that lacks an arm.
        seed: of the shufflings, where the exact distribution is too large.
    """
    strata = _strata(data)
    return strata if isinstance(strata, Unavailable) else _test([_wilcoxon(x, y) for x, y in strata], _weights(strata), strata, seed)


def aligned_rank_test(data: Measurements, *, seed: int = 0) -> StratifiedTest | Unavailable:
    """Run the aligned rank test: values less their visit's mean are ranked over all visits, then shuffled within visits.

    Has more power than van Elteren's test where visits are small, and needs one scale for all visits.
    """
    strata = _strata(data)
    if isinstance(strata, Unavailable):
        return strata
    pooled = [np.concatenate(pair) for pair in strata]
    # Rounded so that values which differ in the last bit after the subtraction count as the ties that they are.
    scale = max(float(np.abs(np.concatenate(pooled)).max()), 1e-300)
    ranks = _doubled_ranks(np.round(np.concatenate([p - p.mean() for p in pooled]) / scale, 12))
    parts = np.split(ranks, np.cumsum([p.size for p in pooled])[:-1])
    return _test([_Stratum(part, x.size, None) for part, (x, _) in zip(parts, strata, strict=True)], [1] * len(parts), strata, seed)


def shift_interval(data: Measurements, level: float = 0.95, *, seed: int = 0) -> ShiftInterval | Unavailable:
    """Estimate the shift that is common to all visits, by inversion of van Elteren's test.

    The p-value changes only where a shift makes two sessions of a visit equal, so it is asked at those shifts and between them.

    Raises:
        ValueError: a level outside (0, 1).
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval must be between 0 and 1, not {level}")
    strata = _strata(data)
    if isinstance(strata, Unavailable):
        return strata
    weights = _weights(strata)
    pairs = [np.subtract.outer(x, y).ravel() for x, y in strata]
    differences, mass = np.concatenate(pairs), np.repeat(np.array(weights, dtype=np.float64), [p.size for p in pairs])
    if all(np.unique(arm).size == arm.size for pair in strata for arm in pair):
        return _untied_interval(strata, weights, differences, mass, level, seed)
    inversion = _Inversion(strata, weights, _distinct(differences), (1 - level) / 2, seed)
    low, high = inversion.end(upper=False), inversion.end(upper=True)
    return ShiftInterval(_weighted_median(differences, mass), low, high, level, inversion.method)


@dataclass(frozen=True)
class _Stratum:
    """Doubled scores of a visit's sessions, the controller's first; and, for Wilcoxon, the sizes of ties that give its distribution."""

    scores: Integers
    n_tested: int
    ties: tuple[int, ...] | None

    @property
    def observed(self) -> int:
        return int(self.scores[: self.n_tested].sum()) - self.lowest

    @property
    def lowest(self) -> int:
        """Offset that is subtracted so that the smallest possible sum is near 0."""
        if self.ties is not None:
            return self.n_tested * (self.n_tested + 1)
        return int(np.sort(self.scores)[: self.n_tested].sum())

    @property
    def cost(self) -> float:
        few = min(self.n_tested, self.scores.size - self.n_tested)
        return float(self.scores.size * few * (self.scores.max() - self.scores.min() + 1) * few)

    def distribution(self) -> Floats:
        """Compute the probabilities of the sum less `lowest`."""
        if self.ties is None:
            return _subset_sums(tuple((self.scores - self.scores.min()).tolist()), self.n_tested)
        if max(self.ties) > 1:
            return u_distribution_given_ties(self.n_tested, self.ties)
        doubled = np.zeros(2 * self.n_tested * (self.scores.size - self.n_tested) + 1)
        doubled[::2] = u_distribution(self.n_tested, self.scores.size - self.n_tested)
        return doubled


def _strata(data: Measurements) -> list[tuple[Floats, Floats]] | Unavailable:
    return [(data.value[one], data.value[two]) for _, one, two in data.arms] or data.no_evidence()


def _weights(strata: Sequence[tuple[Floats, Floats]]) -> list[int]:
    sizes = [x.size + y.size + 1 for x, y in strata]
    rounded = [round(WEIGHT_STEPS * max(sizes) / size) for size in sizes]
    common = reduce(gcd, rounded)
    return [w // common for w in rounded]


def _wilcoxon(x: Floats, y: Floats) -> _Stratum:
    pooled = np.concatenate([x, y])
    ties = tuple(np.unique(pooled, return_counts=True)[1].tolist())
    return _Stratum(_doubled_ranks(pooled), x.size, ties)


def _doubled_ranks(values: Floats) -> Integers:
    """Compute twice the mid-ranks, which are whole numbers."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    below = np.cumsum(counts) - counts
    return (2 * below + counts + 1)[place]


@lru_cache(maxsize=512)
def _subset_sums(scores: tuple[int, ...], chosen: int) -> Floats:
    """Compute the probabilities of the sum of `chosen` of the scores less the smallest such sum, every choice equally likely."""
    few = min(chosen, len(scores) - chosen)
    ordered = sorted(scores)
    counts = np.zeros((few + 1, sum(ordered[len(ordered) - few :]) + 1))
    counts[0, 0] = 1.0
    for score in ordered:
        counts[1:, score:] += counts[:-1, : counts.shape[1] - score].copy()
    row = counts[few]
    if few < chosen:  # the sum of the others is the total less this one
        row = row[::-1]
    row = np.trim_zeros(row)
    row = row / row.sum()
    row.flags.writeable = False
    return row


def _test(parts: Sequence[_Stratum], weights: Sequence[int], strata: Sequence[tuple[Floats, Floats]], seed: int) -> StratifiedTest:
    observed = sum(w * p.observed for w, p in zip(weights, parts, strict=True))
    length = 1 + sum(w * _span(p) for w, p in zip(weights, parts, strict=True))
    sizes = len(strata), sum(x.size for x, _ in strata), sum(y.size for _, y in strata)
    expected = float(sum(w * (p.scores.mean() * p.n_tested - p.lowest) for w, p in zip(weights, parts, strict=True)))
    if length > LARGEST_LATTICE or max(p.cost for p in parts) > LARGEST_TABLE:
        # The data count as one of the shufflings, which keeps the level.
        drawn = _draws(parts, weights, seed)
        greater, less = (1 + int(np.sum(drawn >= observed))) / (DRAWS + 1), (1 + int(np.sum(drawn <= observed))) / (DRAWS + 1)
        method, draws = Method.MONTE_CARLO, DRAWS
    else:
        null = _convolve([p.distribution() for p in parts], weights)
        greater, less = float(min(1.0, null[observed:].sum())), float(min(1.0, null[: observed + 1].sum()))
        method, draws = Method.EXACT, 0
    return StratifiedTest(min(1.0, 2 * min(greater, less)), greater, less, float(observed), expected, method, draws, *sizes)


def _span(part: _Stratum) -> int:
    """Subtract the smallest sum from the largest."""
    if part.ties is not None:
        return 2 * part.n_tested * (part.scores.size - part.n_tested)
    ordered = np.sort(part.scores)
    return int(ordered[-part.n_tested :].sum() - ordered[: part.n_tested].sum())


def _convolve(distributions: Sequence[Floats], weights: Sequence[int]) -> Floats:
    """Compute the distribution of the weighted sum of independent whole numbers."""
    length = 1 + sum(w * (d.size - 1) for d, w in zip(distributions, weights, strict=True))
    if len(distributions) == 1 and weights[0] == 1:
        return distributions[0]
    padded = next_fast_len(length, real=True)
    product: NDArray[np.complex128] | None = None
    for distribution, weight in zip(distributions, weights, strict=True):
        spread = np.zeros(padded)
        spread[: weight * (distribution.size - 1) + 1 : weight] = distribution
        transform = rfft(spread)
        product = transform if product is None else product * transform
    return np.maximum(irfft(product, padded)[:length], 0.0)


def _draws(parts: Sequence[_Stratum], weights: Sequence[int], seed: int) -> Integers:
    """Draw the statistic of random shufflings, [DRAWS]."""
    rng = np.random.default_rng(seed)
    total = np.zeros(DRAWS, dtype=np.int64)
    for part, weight in zip(parts, weights, strict=True):
        shuffled = rng.permuted(np.tile(part.scores, (DRAWS, 1)), axis=1)
        total += weight * (shuffled[:, : part.n_tested].sum(1) - part.lowest)
    return total


def _distinct(values: Floats) -> Floats:
    """Sort values; those that differ by rounding alone count as one."""
    ordered = np.sort(values)
    tolerance = 1e-12 * max(1.0, float(np.abs(ordered).max()))
    return ordered[np.concatenate([[True], np.diff(ordered) > tolerance])]


def _weighted_median(values: Floats, mass: Floats) -> float:
    order = np.argsort(values, kind="stable")
    heights = np.cumsum(mass[order])
    half = heights[-1] / 2
    low = int(np.searchsorted(heights, half - 1e-9))
    high = int(np.searchsorted(heights, half + 1e-9))
    return float((values[order[low]] + values[order[min(high, values.size - 1)]]) / 2)


def _untied_interval(
    strata: Sequence[tuple[Floats, Floats]], weights: Sequence[int], differences: Floats, mass: Floats, level: float, seed: int
) -> ShiftInterval:
    """Compute the interval where no arm of a visit has a value twice: the distribution is then the same at every shift between two
    differences.

    A shift that passes a difference of visit v takes 2 w_v off the statistic, so that the ends are differences counted off from outside.
    """
    order = np.argsort(differences, kind="stable")
    ordered = np.concatenate([[-np.inf], differences[order], [np.inf]])
    steps = 2 * np.cumsum(np.concatenate([[0.0], mass[order]])).astype(np.int64)
    # Any values without a tie have the distribution.
    ranked = [_wilcoxon(np.arange(float(x.size)), x.size + np.arange(float(y.size))) for x, y in strata]
    tail = (1 - level) / 2 + ROUNDING
    estimate = _weighted_median(differences, mass)
    if int(steps[-1]) >= LARGEST_LATTICE or max(p.cost for p in ranked) > LARGEST_TABLE:
        drawn = np.sort(_draws(ranked, weights, seed))
        below = (1 + np.searchsorted(drawn, np.arange(steps[-1] + 1), side="right")) / (DRAWS + 1)
        method = Method.MONTE_CARLO
    else:
        below = np.cumsum(_convolve([p.distribution() for p in ranked], weights))
        method = Method.EXACT
    # Beyond k differences the statistic is its largest value less steps[k]; without ties its distribution is symmetric.
    low = int(np.flatnonzero(below[steps] > tail)[0])
    high = int(np.flatnonzero(below[steps[-1] - steps] > tail)[-1])
    return ShiftInterval(estimate, float(ordered[low]), float(ordered[high + 1]), level, method)


class _Inversion:
    """The shifts that the test does not reject; place 2 k + 1 is the k-th knot, even places lie between knots and beyond the outermost."""

    def __init__(self, strata: Sequence[tuple[Floats, Floats]], weights: Sequence[int], knots: Floats, tail: float, seed: int) -> None:
        self.strata, self.weights, self.knots, self.tail, self.seed = strata, weights, knots, tail, seed
        self.tolerance = 1e-12 * max(1.0, float(np.abs(knots).max()))
        self.tested: dict[int, StratifiedTest] = {}

    @property
    def method(self) -> Method:
        return Method.MONTE_CARLO if any(t.method is Method.MONTE_CARLO for t in self.tested.values()) else Method.EXACT

    def end(self, *, upper: bool) -> float:
        """Find the outermost shift on one side that is not rejected."""
        last = 2 * self.knots.size
        outside, inside = (last, 0) if upper else (0, last)
        if self._accepted(outside, upper):
            return float("inf") if upper else float("-inf")
        # Bisection between a rejected and an accepted place; the tail falls outwards but for the steps that ties make.
        while abs(outside - inside) > 1:
            middle = (outside + inside) // 2
            if self._accepted(middle, upper):
                inside = middle
            else:
                outside = middle
        step = 1 if upper else -1
        for place in range(inside + step, inside + 5 * step, step):
            if 0 < place < last and self._accepted(place, upper):
                inside = place
        zero = self._place_of_zero()
        if (zero - inside) * step > 0 and self._accepted(zero, upper):
            inside = zero
        return self._outer_edge(inside, upper)

    def _accepted(self, place: int, upper: bool) -> bool:
        test = self._test_at(place)
        return (test.p_less if upper else test.p_greater) > self.tail + ROUNDING

    def _test_at(self, place: int) -> StratifiedTest:
        if place not in self.tested:
            shift = self._shift(place)
            moved = [(self._snap(x - shift, y), y) for x, y in self.strata]
            self.tested[place] = _test([_wilcoxon(x, y) for x, y in moved], self.weights, moved, self.seed)
        return self.tested[place]

    def _snap(self, x: Floats, y: Floats) -> Floats:
        """Make moved values equal to a value of the other arm where they differ by rounding alone."""
        nearest = y[np.abs(np.subtract.outer(x, y)).argmin(1)]
        return np.where(np.abs(x - nearest) <= 4 * self.tolerance, nearest, x)

    def _shift(self, place: int) -> float:
        k, at_knot = divmod(place, 2)
        if at_knot:
            return float(self.knots[k])
        if k == 0:
            return float(self.knots[0] - 1.0 - abs(self.knots[0]))
        if k == self.knots.size:
            return float(self.knots[-1] + 1.0 + abs(self.knots[-1]))
        return float((self.knots[k - 1] + self.knots[k]) / 2)

    def _place_of_zero(self) -> int:
        k = int(np.searchsorted(self.knots, -4 * self.tolerance))
        return 2 * k + 1 if k < self.knots.size and self.knots[k] <= 4 * self.tolerance else 2 * k

    def _outer_edge(self, place: int, upper: bool) -> float:
        k, at_knot = divmod(place, 2)
        return float(self.knots[k] if at_knot or upper else self.knots[k - 1])
