"""Sensitivity of the comparison with the same visit's cDBS to other influences of the visit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr, stdtrit

from ml.statistics.within_visits.averages import adjusted_average
from ml.statistics.within_visits.contrasts import (
    LEAST_FOR_SKEWNESS,
    Adjustment,
    Average,
    Floats,
    Integers,
    Measurements,
    Reason,
    Unavailable,
    VisitContrasts,
    average,
    skewed,
    skewness_of,
    unskewed,
    visit_contrasts,
)


@dataclass(frozen=True)
class Sensitivity:
    """One alternative analysis: what was taken out, and the average or why there is none."""

    adjustment: Adjustment
    result: Average | Unavailable


def sensitivities(data: Measurements, level: float = 0.95) -> tuple[Sensitivity, ...]:
    """Run all alternative analyses of one metric, in the order of `Adjustment`."""
    return (
        Sensitivity(Adjustment.NONE, average(visit_contrasts(data), level)),
        Sensitivity(Adjustment.ORDER, order_adjusted(data, level)),
        Sensitivity(Adjustment.CARRY_OVER, carry_over_adjusted(data, level)),
        Sensitivity(Adjustment.MEDICATION, medication_adjusted(data, level)),
        Sensitivity(Adjustment.BRACKETED, bracketed(data, level)),
        Sensitivity(Adjustment.SKEWNESS, skewness_corrected(data, level)),
    )


def order_adjusted(data: Measurements, level: float = 0.95) -> Average | Unavailable:
    """Adjust for a linear drift over the visit, the same at every visit."""
    if data.order is None:
        return Unavailable(Reason.NOT_RECORDED)
    return adjusted_average(data, [data.order], Adjustment.ORDER, level)


def medication_adjusted(data: Measurements, level: float = 0.95) -> Average | Unavailable:
    """Adjust for a quadratic in the time since the last dose: the effect rises, then wears off."""
    if data.medication_h is None or not np.isfinite(data.medication_h).any():
        return Unavailable(Reason.NOT_RECORDED)
    hours = data.medication_h - np.nanmean(data.medication_h)
    quadratic = adjusted_average(data, [hours, hours**2], Adjustment.MEDICATION, level)
    if isinstance(quadratic, Unavailable) and quadratic.reason is Reason.NOT_IDENTIFIED:
        return adjusted_average(data, [hours], Adjustment.MEDICATION, level)
    return quadratic


def carry_over_adjusted(data: Measurements, level: float = 0.95) -> Average | Unavailable:
    """Adjust for whether the session before it, among those of both arms, was the controller's. The first of a visit has none before it."""
    if data.order is None:
        return Unavailable(Reason.NOT_RECORDED)
    return adjusted_average(data, [_after_tested(data)], Adjustment.CARRY_OVER, level)


def bracketed(data: Measurements, level: float = 0.95) -> Average | Unavailable:
    """Compare only sessions between two measured cDBS sessions of the visit, each with those two, weighted by nearness in the order.

    A drift that is linear over such a stretch cancels.
    """
    if data.order is None:
        return Unavailable(Reason.NOT_RECORDED)
    contrasts = visit_contrasts(data)
    if isinstance(contrasts, Unavailable):
        return contrasts
    visits, found, n_tested, n_cdbs = [], [], [], []
    for visit, one, two in data.arms:
        differences, used = _against_neighbours(data.value, data.order, one, two)
        if differences:
            visits.append(visit)
            found.append(float(np.mean(differences)))
            n_tested.append(len(differences))
            n_cdbs.append(len(used))
    if not found:
        return Unavailable(Reason.NO_BRACKETED_SESSION, 0, 1)
    sizes = np.array(n_tested, dtype=np.int64), np.array(n_cdbs, dtype=np.int64)
    floor = data.resolution**2 / 12 * (1 / sizes[0] + 1 / sizes[1])
    result = average(VisitContrasts(np.array(visits, dtype=np.int64), np.array(found), *sizes, floor, 0.0, data.bounded), level)
    return result if isinstance(result, Unavailable) else replace(result, adjustment=Adjustment.BRACKETED)


def skewness_corrected(data: Measurements, level: float = 0.95) -> Average | Unavailable:
    """Adjust Student's ratio of the visits' contrasts for their skewness, whatever the metric (`contrasts.unskewed`)."""
    contrasts = visit_contrasts(data)
    if isinstance(contrasts, Unavailable):
        return contrasts
    plain, n = average(contrasts, level), contrasts.visits
    if isinstance(plain, Unavailable):
        return plain
    if n < LEAST_FOR_SKEWNESS:
        return Unavailable(Reason.TOO_FEW_VISITS, n, LEAST_FOR_SKEWNESS)
    error, quantile = plain.standard_error, float(stdtrit(n - 1, (1 + level) / 2))
    skewness = skewness_of(contrasts.contrast, n * error**2)
    ratio = float(unskewed(plain.estimate / error, skewness, n))
    return replace(
        plain,
        low=plain.estimate - error * skewed(quantile, skewness, n),
        high=plain.estimate - error * skewed(-quantile, skewness, n),
        p_value=2 * float(stdtr(n - 1, -abs(ratio))),
        adjustment=Adjustment.SKEWNESS,
    )


def _after_tested(data: Measurements) -> Floats:
    after, order = np.zeros(data.value.size), np.asarray(data.order)
    for v in np.unique(data.visit):
        rows = np.flatnonzero(data.visit == v)
        rows = rows[np.argsort(order[rows], kind="stable")]
        after[rows[1:]] = data.tested[rows[:-1]]
    after[~np.isfinite(order)] = np.nan
    return after


def _against_neighbours(value: Floats, order: Floats, one: Integers, two: Integers) -> tuple[list[float], set[int]]:
    """Compute differences of the bracketed sessions of a visit from their neighbours, and which cDBS sessions were used."""
    cdbs = two[np.isfinite(order[two])]
    differences: list[float] = []
    used: set[int] = set()
    for i in one[np.isfinite(order[one])]:
        before, after = cdbs[order[cdbs] < order[i]], cdbs[order[cdbs] > order[i]]
        if before.size and after.size:
            b, a = int(before[np.argmax(order[before])]), int(after[np.argmin(order[after])])
            nearness = (order[i] - order[b]) / (order[a] - order[b])
            differences.append(float(value[i] - (1 - nearness) * value[b] - nearness * value[a]))
            used |= {a, b}
    return differences, used
