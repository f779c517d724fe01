"""A controller against the cDBS sessions of the same visit, with the visit as the unit of evidence.

Each visit that has both arms gives one contrast; the average of the contrasts is held against their spread by Student's t with one degree
of freedom fewer than visits. Days that differ, days on which the controller does better or worse than on others, and visits of different
size all end up in that spread, so that sessions of one visit never count as independent evidence. The test keeps its level for contrasts
that are normal with unequal variances (Bakirov and Szekely 2005; Ibragimov and Mueller 2010): two-sided up to 8.3 %, one-sided up to 5 %
for 2 to 14 visits.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtr, stdtrit

from ml.statistics.within_visits.cells import Cells, cells_of

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Scale = Literal["difference", "win_probability", "ordinal"]

UNBALANCED = 0.5
"""Arms whose mean places in the order differ by more than this many standard deviations of the place, on average over visits, are compared
with an adjustment for the order. The rule looks at the design alone, never at what was measured."""


class Reason(StrEnum):
    """Why a number is not given."""

    NO_SESSION = "no_session"
    NO_VISIT_WITH_BOTH_ARMS = "no_visit_with_both_arms"
    TOO_FEW_VISITS = "too_few_visits"
    TOO_FEW_PARTICIPANTS = "too_few_participants"
    NO_VARIANCE = "no_variance"
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
    """What a contrast is freed from."""

    NONE = "none"
    ORDER = "order"
    CARRY_OVER = "carry_over"
    MEDICATION = "medication"
    BRACKETED = "bracketed"
    SKEWNESS = "skewness"


@dataclass(frozen=True)
class Measurements:
    """One metric of a controller's sessions and of the cDBS sessions they are held against; n sessions.

    Attributes:
        value: [n], NaN where it was not measured.
        visit: visit number, [n].
        tested: True for the controller, False for cDBS, [n].
        order: place or start time of the session in its visit (any unit), [n]; None where it is not known.
        medication_h: hours since the last dose, [n], NaN where not known; None where none is known.
        resolution: step between neighbouring values (1 for a rating in whole points), 0 for a continuous metric.

    Raises:
        ValueError: shapes that differ, an infinite value, or a resolution below zero.
    """

    value: Floats
    visit: Integers
    tested: NDArray[np.bool_]
    order: Floats | None = None
    medication_h: Floats | None = None
    resolution: float = 0.0

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
    ) -> Measurements:
        """From anything that numpy can read; errors as in the class."""
        return cls(
            np.asarray(value, dtype=np.float64).ravel(),
            np.asarray(visit, dtype=np.int64).ravel(),
            np.asarray(tested, dtype=np.bool_).ravel(),
            None if order is None else np.asarray(order, dtype=np.float64).ravel(),
            None if medication_h is None else np.asarray(medication_h, dtype=np.float64).ravel(),
            resolution,
        )

    def take(self, rows: NDArray[np.bool_] | Integers) -> Measurements:
        """Some of the sessions."""
        return Measurements(
            self.value[rows],
            self.visit[rows],
            self.tested[rows],
            None if self.order is None else self.order[rows],
            None if self.medication_h is None else self.medication_h[rows],
            self.resolution,
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

    def no_evidence(self) -> Unavailable:
        """Why no visit has both arms."""
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
        null: value of the contrast where the arms do not differ.
    """

    visit: Integers
    contrast: Floats
    n_tested: Integers
    n_cdbs: Integers
    floor: Floats
    null: float

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

    def p_above(self, value: float) -> float:
        """One-sided p of the hypothesis that the average is `value` or less."""
        return float(stdtr(self.degrees, (value - self.estimate) / self.standard_error))

    def p_below(self, value: float) -> float:
        """One-sided p of the hypothesis that the average is `value` or more."""
        return float(stdtr(self.degrees, (self.estimate - value) / self.standard_error))


def visit_contrasts(data: Measurements, scale: Scale = "difference") -> VisitContrasts | Unavailable:
    """The contrast of every visit with both arms.

    Args:
        data: sessions of both arms; those without a value are left out.
        scale: `difference` of means, or `win_probability`: the share of pairs of one session of either arm of the visit in which the
            controller's value is the higher one, ties counting one half (then the null is 0.5). `ordinal` is the same for steps of
            `resolution`, to which a shift may have been added: pairs less than a step apart count in proportion, so that a shift between
            two whole steps lies between what these give.

    Returns:
        The contrasts, or why there is none: no session of an arm, or no visit with both.
    """
    cells = data.cells
    if not cells.visit.size:
        return data.no_evidence()
    n_tested, n_cdbs = cells.counts.T
    if scale == "difference":
        means = cells.means(data.value[cells.rows])
        contrast = means[:, 0] - means[:, 1]
        # Rounding to steps of r adds a variance of r^2 / 12 to every session (Sheppard 1898).
        floor = data.resolution**2 / 12 * (1 / n_tested + 1 / n_cdbs)
    else:
        step = step_of(data, scale)
        contrast = np.array([win_probability(data.value[one], data.value[two], step) for _, one, two in data.arms])
        # A visit resolves the probability no finer than by half a pair.
        floor = (0.5 / (n_tested * n_cdbs)) ** 2
    return VisitContrasts(cells.visit, contrast, n_tested, n_cdbs, floor, 0.0 if scale == "difference" else 0.5)


def win_probability(x: Floats, y: Floats, step: float = 0.0) -> float:
    """Share of pairs with x > y, ties counting one half; of a scale in steps, pairs less than a step apart count in proportion."""
    return float(pairs(x, y, step).mean())


def pairs(x: Floats, y: Floats, step: float = 0.0) -> Floats:
    """What each pair counts for `win_probability`, 0 to 1, [n_x, n_y]."""
    difference = np.subtract.outer(x, y)
    return np.asarray(0.5 + 0.5 * (np.clip(difference / step, -1.0, 1.0) if step else np.sign(difference)))


def step_of(data: Measurements, scale: Scale) -> float:
    """Step of the comparison of pairs; 0 where any difference counts whole."""
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


def student(
    estimate: float, variance: float, of: VisitContrasts, level: float, adjustment: Adjustment, at_most: float = np.inf
) -> Average | Unavailable:
    """An average with its variance, on t with one degree of freedom fewer than visits, or `at_most` so many."""
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval lies between 0 and 1, not at {level}")
    scale = 1e-12 * max(1.0, float(np.abs(of.contrast).max()))
    error, degrees = float(np.sqrt(variance)), min(of.visits - 1, at_most)
    if error <= scale:
        return Unavailable(Reason.NO_VARIANCE)
    half = float(stdtrit(degrees, (1 + level) / 2)) * error
    p = 2 * float(stdtr(degrees, -abs(estimate - of.null) / error))
    counts = int(of.n_tested.sum()), int(of.n_cdbs.sum())
    return Average(estimate, estimate - half, estimate + half, level, p, error, degrees, of.null, of.visits, *counts, adjustment)


def order_imbalance(data: Measurements) -> float | None:
    """How much later the controller's sessions come than cDBS, on average over visits, in standard deviations of the place in the visit.

    None where no order is known or no visit has both arms.
    """
    cells = data.cells
    if data.order is None or not cells.visit.size:
        return None
    order = data.order[cells.rows]
    if not np.isfinite(order).all():
        return None
    sums, of_visit = cells.sums(order), cells.cell // 2
    n = cells.counts.sum(1)
    away = order - (sums.sum(1) / n)[of_visit]
    spread = np.sqrt(np.bincount(of_visit, weights=away**2, minlength=n.size) / n)
    later = sums[:, 0] / cells.counts[:, 0] - sums[:, 1] / cells.counts[:, 1]
    return float(np.mean(np.divide(later, spread, out=np.zeros_like(later), where=spread > 0)))


def primary(data: Measurements, level: float = 0.95, scale: Scale = "difference") -> Average | Unavailable:
    """The primary comparison: the average over visits, adjusted for the order where the design puts one arm later than the other.

    Returns:
        The average with its `adjustment`. Where the order is unbalanced and cannot be told apart from the controller it is unadjusted, and
        `order_imbalance` says so.
    """
    imbalance = order_imbalance(data)
    if imbalance is not None and abs(imbalance) > UNBALANCED:
        adjusted = adjusted_average(data, [np.asarray(data.order)], Adjustment.ORDER, level, scale)
        if isinstance(adjusted, Average):
            return adjusted
    return average(visit_contrasts(data, scale), level)


def adjusted_average(
    data: Measurements, covariates: list[Floats], adjustment: Adjustment, level: float = 0.95, scale: Scale = "difference"
) -> Average | Unavailable:
    """Average over visits of contrasts freed from covariates whose slopes are common to all visits and arms.

    The slopes come from what varies within one arm of one visit. They tie the contrasts of the visits together, so that the variance is
    that of leaving out one visit at a time, slopes included (the cluster jackknife, CV3 of MacKinnon, Nielsen and Webb 2023).

    Args:
        data: sessions of both arms. covariates: each [n], as `data`; sessions with an unknown one are left out.
        scale: as in `visit_contrasts`, of the values less what the covariates explain.

    Returns:
        The average, or why there is none: as in `average`, or slopes that the sessions do not identify.
    """
    known = np.isfinite(data.value) & np.all(np.isfinite(covariates), axis=0)
    table = np.column_stack([c[known] for c in covariates])
    kept = data.take(known)
    contrasts = visit_contrasts(kept, scale)
    if isinstance(contrasts, Unavailable):
        return contrasts
    n = contrasts.visits
    if n < 2:
        return Unavailable(Reason.TOO_FEW_VISITS, n, 2)
    slopes = _common_slopes(kept, table)
    if slopes is None:
        return Unavailable(Reason.NOT_IDENTIFIED)
    # Contrasts [V + 1, V]: with the slopes of all visits, and with those of all but one.
    if scale == "difference":
        shift = np.array([table[one].mean(0) - table[two].mean(0) for _, one, two in kept.arms])
        freed = contrasts.contrast - slopes @ shift.T
    else:
        values = kept.value - slopes @ table.T
        step = step_of(kept, scale)
        freed = np.array([[win_probability(row[one], row[two], step) for _, one, two in kept.arms] for row in values])
    estimate = float(freed[0].mean())
    without = (freed[1:].sum(1) - np.diag(freed[1:])) / (n - 1)
    variance = (n - 1) / n * float(np.sum((without - without.mean()) ** 2))
    floor = float(contrasts.floor.mean()) / n
    return student(estimate, variance + floor if contrasts.null else max(variance, floor), contrasts, level, adjustment)


def _common_slopes(data: Measurements, table: Floats) -> Floats | None:
    """Slopes on covariates [n, c] within arms of visits, of all visits and without each, [V + 1, c]; None where they are not identified."""
    grams, moments = [], []
    for _, one, two in data.arms:
        centred = np.concatenate([table[arm] - table[arm].mean(0) for arm in (one, two)])
        values = np.concatenate([data.value[arm] - data.value[arm].mean() for arm in (one, two)])
        grams.append(centred.T @ centred)
        moments.append(centred.T @ values)
    gram, moment = np.array(grams), np.array(moments)
    totals = np.concatenate([gram.sum(0)[None], gram.sum(0) - gram])
    if min(_smallest_share(g, totals[0]) for g in totals) < 1e-6:
        return None
    return np.asarray(np.linalg.solve(totals, np.concatenate([moment.sum(0)[None], moment.sum(0) - moment])[..., None])[..., 0])


def _smallest_share(gram: Floats, whole: Floats) -> float:
    """Smallest eigenvalue of a gram matrix whose columns are scaled by those of another."""
    scale = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    if not np.diag(whole).all():
        return 0.0
    return float(np.linalg.eigvalsh(gram / np.outer(scale, scale))[0])
