"""Primary comparison of a controller with the same visit's cDBS: the average of the visits' contrasts. Where the design puts one arm later
than the other, the average is adjusted for the order."""

from __future__ import annotations

import numpy as np

from ml.statistics.within_visits.contrasts import (
    Adjustment,
    Average,
    Floats,
    Measurements,
    Reason,
    Scale,
    Unavailable,
    average,
    step_of,
    student,
    visit_contrasts,
    win_probability,
)

UNBALANCED = 0.5
"""Limit of the mean difference in place between arms, in standard deviations of the place, averaged over visits. Above it the comparison is
adjusted for the order. The rule looks at the design alone, never at what was measured."""


def order_imbalance(data: Measurements) -> float | None:
    """Measure how much later the controller's sessions come than cDBS, on average over visits, in standard deviations of the place in the
    visit.

    None where no order is known or no visit has both arms.
    """
    return data.imbalance


def primary(data: Measurements, level: float = 0.95, scale: Scale = "difference") -> Average | Unavailable:
    """Average the primary comparison over visits, adjusted for the order where the design puts one arm later than the other.

    Returns:
        The average with its `adjustment`. Where the order is unbalanced and cannot be separated from the controller it is unadjusted, and
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

    The slopes come from what varies within one arm of one visit. They tie the contrasts of the visits together. So the variance excludes
    one visit at a time, slopes included (the cluster jackknife, CV3 of MacKinnon, Nielsen and Webb 2023).

    Args:
        data: sessions of both arms. covariates: each [n], as `data`; sessions with an unknown one are excluded.
        scale: as in `visit_contrasts`, of the values less what the covariates explain.

    Returns:
        The average, or why there is none: as in `average`, or slopes that the sessions do not identify.
    """
    known = np.isfinite(data.value) & np.all(np.isfinite(covariates), axis=0)
    table = np.column_stack([c[known] for c in covariates])
    kept = data if known.all() else data.take(known)
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
    return student(estimate, variance + floor if contrasts.null else max(variance, floor), contrasts, level, adjustment, freed=freed[0])


def _common_slopes(data: Measurements, table: Floats) -> Floats | None:
    """Fit slopes on covariates [n, c] within arms of visits, of all visits and without each, [V + 1, c]; None where they are not
    identified."""
    grams, moments = [], []
    for _, one, two in data.arms:
        centred = np.concatenate([table[arm] - table[arm].mean(0) for arm in (one, two)])
        values = np.concatenate([data.value[arm] - data.value[arm].mean() for arm in (one, two)])
        grams.append(centred.T @ centred)
        moments.append(centred.T @ values)
    gram, moment = np.array(grams), np.array(moments)
    totals = np.concatenate([gram.sum(0)[None], gram.sum(0) - gram])
    if _smallest_share(totals, totals[0]) < 1e-6:
        return None
    return np.asarray(np.linalg.solve(totals, np.concatenate([moment.sum(0)[None], moment.sum(0) - moment])[..., None])[..., 0])


def _smallest_share(grams: Floats, whole: Floats) -> float:
    """Compute the smallest eigenvalue of gram matrices [k, c, c] whose columns are scaled by those of another."""
    scale = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    if not np.diag(whole).all():
        return 0.0
    return float(np.linalg.eigvalsh(grams / np.outer(scale, scale)).min())
