"""A controller against the cDBS sessions of the same visit, with the visit as the unit of evidence.

Each visit that has both arms gives one contrast. Student's t compares the average of the contrasts with their spread, with one degree of
freedom fewer than visits. That spread includes three things: days that differ, effects that differ between days, and visits of different
size. So sessions of one visit never count as independent evidence. The test keeps its level for normal contrasts with unequal variances
(Bakirov and Szekely 2005; Ibragimov and Mueller 2010). That is proven two-sided up to 8.3 %, and one-sided up to 5 % for 2 to 14 visits.

A metric with a floor or a ceiling has skewed contrasts where the effect differs between visits, and Student's ratio then errs. Of such a
metric the larger p counts of Student's ratio and of the same freed from its skewness (Hall 1992), and the
interval holds both. The rule looks at the metric alone, never at what was measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtr, stdtrit

from ml.statistics.within_visits.cells import Cells, cells_of

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Scale = Literal["difference", "win_probability", "ordinal"]

LEAST_FOR_SKEWNESS = 3
"""Fewest visits whose contrasts can show skewness: two are always symmetric."""


NEGLIGIBLE = 1e-12
"""Differences below this share of the largest value (or of 1) are rounding of the computer."""


class Reason(StrEnum):
    """Reason why a number is not given.

    ALL_EQUAL: every session has the same value. NO_VARIANCE: sessions may differ, but what is averaged over visits is the same at each.
    TOO_FEW_SESSIONS: no arm of a visit has two sessions, and no visit another to differ from. ONE_VISIT: all that varies, varies in one.
    """

    NO_SESSION = "no_session"
    NO_VISIT_WITH_BOTH_ARMS = "no_visit_with_both_arms"
    TOO_FEW_VISITS = "too_few_visits"
    TOO_FEW_PARTICIPANTS = "too_few_participants"
    TOO_FEW_SESSIONS = "too_few_sessions"
    ALL_EQUAL = "all_equal"
    NO_VARIANCE = "no_variance"
    ONE_VISIT = "one_visit"
    NOT_IDENTIFIED = "not_identified"
    NOT_RECORDED = "not_recorded"
    NO_BRACKETED_SESSION = "no_bracketed_session"


@dataclass(frozen=True)
class Unavailable:
    """A number that the data do not give.

    Attributes:
        reason: why. found, needed: how many there are and how many it takes, of what the reason names; both 0 where nothing is counted.
    """

    reason: Reason
    found: int = 0
    needed: int = 0


class Adjustment(StrEnum):
    """Adjustment of a contrast: what it is freed from."""

    NONE = "none"
    ORDER = "order"
    CARRY_OVER = "carry_over"
    MEDICATION = "medication"
    BRACKETED = "bracketed"
    SKEWNESS = "skewness"


@dataclass(frozen=True)
class Measurements:
    """One metric of a controller's sessions and of the cDBS sessions they are compared with; n sessions.

    Attributes:
        value: [n], NaN where it was not measured.
        visit: visit number, [n].
        tested: True for the controller, False for cDBS, [n].
        order: place or start time of the session in its visit (any unit), [n]; None where it is not known.
        medication_h: hours since the last dose, [n], NaN where not known; None where none is known.
        resolution: step between neighbouring values (1 for a rating in whole points), 0 for a continuous metric.
        bounded: whether the metric ends at a floor or a ceiling that sessions reach (a rating of 1 to 10, a share of the time).

    Raises:
        ValueError: shapes that differ, an infinite value, or a resolution below zero.
    """

    value: Floats
    visit: Integers
    tested: NDArray[np.bool_]
    order: Floats | None = None
    medication_h: Floats | None = None
    resolution: float = 0.0
    bounded: bool = False

    def __post_init__(self) -> None:
        shape = self.value.shape
        for name in ("visit", "tested", "order", "medication_h"):
            column = getattr(self, name)
            if column is not None and column.shape != shape:
                raise ValueError(f"`{name}` has the shape {column.shape} and `value` {shape}: give one entry per session in each")
        if np.isinf(self.value).any():
            raise ValueError("an infinite value was given: leave it out, or give NaN where nothing was measured")
        if not self.resolution >= 0:
            raise ValueError(f"the resolution of a metric is 0 or more, not {self.resolution}")

    @classmethod
    def of(
        cls,
        value: ArrayLike,
        visit: ArrayLike,
        tested: ArrayLike,
        *,
        order: ArrayLike | None = None,
        medication_h: ArrayLike | None = None,
        resolution: float = 0.0,
        bounded: bool = False,
    ) -> Measurements:
        """Convert anything that numpy can read; errors as in the class."""
        return cls(
            np.asarray(value, dtype=np.float64).ravel(),
            np.asarray(visit, dtype=np.int64).ravel(),
            np.asarray(tested, dtype=np.bool_).ravel(),
            None if order is None else np.asarray(order, dtype=np.float64).ravel(),
            None if medication_h is None else np.asarray(medication_h, dtype=np.float64).ravel(),
            resolution,
            bounded,
        )

    def take(self, rows: NDArray[np.bool_] | Integers) -> Measurements:
        """Select some of the sessions."""
        return Measurements(
            self.value[rows],
            self.visit[rows],
            self.tested[rows],
            None if self.order is None else self.order[rows],
            None if self.medication_h is None else self.medication_h[rows],
            self.resolution,
            self.bounded,
        )

    @cached_property
    def arms(self) -> tuple[tuple[int, Integers, Integers], ...]:
        """Of every visit with both arms: its number, and the rows of the measured sessions of the controller and of cDBS."""
        known = np.flatnonzero(np.isfinite(self.value))
        known = known[np.argsort(self.visit[known], kind="stable")]
        starts = np.flatnonzero(np.diff(self.visit[known], prepend=np.nan)) if known.size else known
        found = []
        for rows in np.split(known, starts[1:]):
            tested = self.tested[rows]
            if tested.any() and not tested.all():
                found.append((int(self.visit[rows[0]]), rows[tested], rows[~tested]))
        return tuple(found)

    @cached_property
    def cells(self) -> Cells:
        """The measured sessions of visits with both arms, counted by visit and arm."""
        return cells_of(np.isfinite(self.value), self.visit, self.tested)

    @cached_property
    def contrasts(self) -> dict[Scale, VisitContrasts | Unavailable]:
        """Cached results of `visit_contrasts` by scale."""
        return {}

    @cached_property
    def imbalance(self) -> float | None:
        """As `order_imbalance` describes it."""
        cells = self.cells
        if self.order is None or not cells.visit.size:
            return None
        order = self.order[cells.rows]
        if not np.isfinite(order).all():
            return None
        sums, of_visit = cells.sums(order), cells.cell // 2
        n = cells.counts.sum(1)
        away = order - (sums.sum(1) / n)[of_visit]
        spread = np.sqrt(np.bincount(of_visit, weights=away**2, minlength=n.size) / n)
        later = sums[:, 0] / cells.counts[:, 0] - sums[:, 1] / cells.counts[:, 1]
        return float(np.mean(np.divide(later, spread, out=np.zeros_like(later), where=spread > 0)))

    def no_evidence(self) -> Unavailable:
        """Explain why no visit has both arms."""
        tested = self.tested[np.isfinite(self.value)]
        one_arm = not tested.any() or tested.all()
        return Unavailable(Reason.NO_SESSION if one_arm else Reason.NO_VISIT_WITH_BOTH_ARMS, 0, 1)


@dataclass(frozen=True)
class VisitContrasts:
    """One contrast per visit with both arms, V visits.

    Attributes:
        visit: visit numbers, [V]. contrast: controller less cDBS (or the win probability), [V].
        n_tested, n_cdbs: measured sessions of either arm, [V].
        floor: smallest variance that a contrast can have given the steps in which the metric is measured, [V]; 0 for a continuous one.
        null: value of the contrast where the arms do not differ. bounded: whether a contrast ends at a floor or a ceiling.
        tied: whether all sessions behind the contrasts have the same value.
    """

    visit: Integers
    contrast: Floats
    n_tested: Integers
    n_cdbs: Integers
    floor: Floats
    null: float
    bounded: bool = False
    tied: bool = False

    @property
    def visits(self) -> int:
        return self.contrast.size

    @property
    def variance(self) -> float:
        """Of one contrast: at least the floor; a win probability, which moves in steps, has it added as a correction for continuity."""
        spread, floor = float(self.contrast.var(ddof=1)), float(self.floor.mean())
        return spread + floor if self.null else max(spread, floor)


@dataclass(frozen=True)
class Average:
    """An average contrast over visits.

    Attributes:
        estimate: in the unit of the metric. low, high: its interval of `level`.
        p_value: two-sided, of no average difference.
        standard_error, degrees: of the t distribution behind both. null: value of no difference.
        visits: number of visits. n_tested, n_cdbs: sessions in them. adjustment: what the contrasts were freed from.
        skewness: of the contrasts; 0 where Student's ratio counts alone. Else the larger p counts and the interval holds both.
    """

    estimate: float
    low: float
    high: float
    level: float
    p_value: float
    standard_error: float
    degrees: float
    null: float
    visits: int
    n_tested: int
    n_cdbs: int
    adjustment: Adjustment
    skewness: float = 0.0

    def p_above(self, value: float) -> float:
        """Compute the one-sided p of the hypothesis that the average is `value` or less."""
        return float(stdtr(self.degrees, -min(self._ratios(value))))

    def p_below(self, value: float) -> float:
        """Compute the one-sided p of the hypothesis that the average is `value` or more."""
        return float(stdtr(self.degrees, max(self._ratios(value))))

    def _ratios(self, value: float) -> tuple[float, float]:
        """Compute Student's ratio against a value, and the same freed from skewness."""
        ratio = (self.estimate - value) / self.standard_error
        return ratio, float(unskewed(ratio, self.skewness, self.visits))


def visit_contrasts(data: Measurements, scale: Scale = "difference") -> VisitContrasts | Unavailable:
    """Compute the contrast of every visit with both arms.

    Args:
        data: sessions of both arms; those without a value are excluded.
        scale: `difference` of means, `win_probability` or `ordinal`. `win_probability` is the share of pairs in which the controller's
            value is higher. A pair is one session of either arm; ties count one half, so the null is 0.5. `ordinal` is the same for steps
            of `resolution`, to which a shift may have been added. Its pairs less than a step apart count in proportion. So a shift between
            two whole steps gives a value between theirs.

    Returns:
        The contrasts, or why there is none: no session of an arm, or no visit with both. The same object whenever it is asked again.
    """
    if scale not in data.contrasts:
        data.contrasts[scale] = _contrasts(data, scale)
    return data.contrasts[scale]


def _contrasts(data: Measurements, scale: Scale) -> VisitContrasts | Unavailable:
    cells = data.cells
    if not cells.visit.size:
        return data.no_evidence()
    n_tested, n_cdbs = cells.counts.T
    values = data.value[cells.rows]
    tied = bool(np.ptp(values) <= NEGLIGIBLE * max(1.0, float(np.abs(values).max())))
    if scale == "difference":
        means = cells.means(values)
        contrast = means[:, 0] - means[:, 1]
        # Rounding to steps of r adds a variance of r^2 / 12 to every session (Sheppard 1898).
        floor = data.resolution**2 / 12 * (1 / n_tested + 1 / n_cdbs)
    else:
        step = step_of(data, scale)
        contrast = np.array([win_probability(data.value[one], data.value[two], step) for _, one, two in data.arms])
        # A visit resolves the probability no finer than by half a pair.
        floor = (0.5 / (n_tested * n_cdbs)) ** 2
    return VisitContrasts(cells.visit, contrast, n_tested, n_cdbs, floor, 0.0 if scale == "difference" else 0.5, data.bounded, tied)


def win_probability(x: Floats, y: Floats, step: float = 0.0) -> float:
    """Compute the share of pairs with x > y, ties counting one half. On a scale in steps, pairs less than a step apart count in
    proportion."""
    return float(pairs(x, y, step).mean())


def pairs(x: Floats, y: Floats, step: float = 0.0) -> Floats:
    """Compute what each pair counts for `win_probability`, 0 to 1, [n_x, n_y]."""
    difference = np.subtract.outer(x, y)
    return np.asarray(0.5 + 0.5 * (np.clip(difference / step, -1.0, 1.0) if step else np.sign(difference)))


def step_of(data: Measurements, scale: Scale) -> float:
    """Give the step of the comparison of pairs; 0 where any difference counts whole."""
    return data.resolution if scale == "ordinal" else 0.0


def average(contrasts: VisitContrasts | Unavailable, level: float = 0.95) -> Average | Unavailable:
    """Average over visits, every visit counting the same, on t with V - 1 degrees of freedom.

    Returns:
        The average, or why there is none: no contrast, fewer than two visits, or contrasts of a continuous metric that are all equal.

    Raises:
        ValueError: a level outside (0, 1).
    """
    if isinstance(contrasts, Unavailable):
        return contrasts
    if contrasts.visits < 2:
        return Unavailable(Reason.TOO_FEW_VISITS, contrasts.visits, 2)
    return student(float(contrasts.contrast.mean()), contrasts.variance / contrasts.visits, contrasts, level, Adjustment.NONE)


def unskewed(ratio: Any, skewness: Any, visits: Any) -> Any:
    """Free Student's ratio from the skewness of its contrasts by Hall's cubic transformation (Hall 1992), which is monotone.

    Numbers or arrays: the ratio, the third central moment in cubes of the standard deviation, and the number of visits.
    """
    u = ratio / np.sqrt(visits)
    return ratio + np.sqrt(visits) * (skewness * u**2 / 3 + skewness**2 * u**3 / 27 + skewness / (6 * visits))


def skewed(quantile: float, skewness: float, visits: int) -> float:
    """Invert `unskewed`: find the ratio that it takes to a quantile."""
    if abs(skewness) < 1e-6:
        return quantile
    shifted = quantile / np.sqrt(visits) - skewness / (6 * visits)
    return float(3 / skewness * (np.cbrt(1 + skewness * shifted) - 1) * np.sqrt(visits))


def skewness_of(contrasts: Floats, variance: float) -> float:
    """Compute the third central moment of contrasts [V] in cubes of the standard deviation; 0 of fewer than three, whose skewness is
    unknown."""
    if contrasts.size < LEAST_FOR_SKEWNESS or variance <= 0:
        return 0.0
    return float(np.mean((contrasts - contrasts.mean()) ** 3) / variance**1.5)


def student(
    estimate: float,
    variance: float,
    of: VisitContrasts,
    level: float,
    adjustment: Adjustment,
    at_most: float = np.inf,
    freed: Floats | None = None,
) -> Average | Unavailable:
    """Build an average with its variance, on t with one degree of freedom fewer than visits, or `at_most` so many.

    `freed`: the contrasts that it is the average of, [V], where they are not those of `of`.
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval must be between 0 and 1, not {level}")
    scale = NEGLIGIBLE * max(1.0, float(np.abs(of.contrast).max()))
    error, degrees = float(np.sqrt(variance)), min(of.visits - 1, at_most)
    if error <= scale:
        return Unavailable(Reason.ALL_EQUAL if of.tied else Reason.NO_VARIANCE)
    skewness = skewness_of(of.contrast if freed is None else freed, variance * of.visits) if of.bounded else 0.0
    ratio, quantile = (estimate - of.null) / error, float(stdtrit(degrees, (1 + level) / 2))
    p = 2 * float(stdtr(degrees, -min(abs(ratio), abs(float(unskewed(ratio, skewness, of.visits))))))
    low = estimate - error * max(quantile, skewed(quantile, skewness, of.visits))
    high = estimate - error * min(-quantile, skewed(-quantile, skewness, of.visits))
    counts = int(of.n_tested.sum()), int(of.n_cdbs.sum())
    return Average(estimate, low, high, level, p, error, degrees, of.null, of.visits, *counts, adjustment, skewness)
