"""Does one measurement of a session go with another, such as beta with a QoC or with amplitude: within visits and between them, kept apart.

Within visits, each visit's means are subtracted; the common slope and the correlation describe the rest (Bland and Altman 1995). The
interval comes from excluding one visit at a time. It uses t with degrees of freedom between visits - 1 and effective visits - 1. So
sessions of one visit never count as independent. Between visits, the same is done with the visits' means.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from ml.statistics.within_visits.contrasts import Integers, Reason, Unavailable

Floats = NDArray[np.float64]
LEAST_VISITS = 3


@dataclass(frozen=True)
class Association:
    """A slope and a correlation.

    Attributes:
        slope: of y on x, in units of y per unit of x. low, high: its interval of `level`. p_value: two-sided, of no slope.
        correlation: Pearson's. correlation_low, correlation_high: its interval, by Fisher's z.
        visits: number of visits. sessions: in them.
    """

    slope: float
    low: float
    high: float
    level: float
    p_value: float
    correlation: float
    correlation_low: float
    correlation_high: float
    visits: int
    sessions: int


def within_visits(x: Floats, y: Floats, visit: Integers, level: float = 0.95) -> Association | Unavailable:
    """Estimate the association of y with x within visits.

    Args:
        x, y: of every session, [n], NaN where not known. visit: numbers, [n]. level: coverage of the intervals.

    Returns:
        The association, or why there is none: fewer than three visits with two sessions or more, or no variance of x or y within visits.
    """
    _check(x, y, visit, level)
    known = np.isfinite(x) & np.isfinite(y)
    sums = []
    sessions = 0
    for v in np.unique(visit[known]):
        rows = known & (visit == v)
        if rows.sum() > 1:
            a, b = x[rows] - x[rows].mean(), y[rows] - y[rows].mean()
            sums.append((a @ a, a @ b, b @ b))
            sessions += int(rows.sum())
    n = len(sums)
    if n < LEAST_VISITS:
        return Unavailable(Reason.TOO_FEW_VISITS, n, LEAST_VISITS)
    parts = np.array(sums)
    if not _varies(x[known], parts[:, 0]) or not _varies(y[known], parts[:, 2]):
        return Unavailable(Reason.ALL_EQUAL)
    return _jackknife(parts.sum(0), parts.sum(0) - parts, n, sessions, level)


def between_visits(x: Floats, y: Floats, visit: Integers, level: float = 0.95) -> Association | Unavailable:
    """Estimate the association of the visits' means, by the ordinary regression of V points; arguments as in `within_visits`."""
    _check(x, y, visit, level)
    known = np.isfinite(x) & np.isfinite(y)
    numbers = np.unique(visit[known])
    n, sessions = numbers.size, int(known.sum())
    if n < LEAST_VISITS + 1:
        return Unavailable(Reason.TOO_FEW_VISITS, n, LEAST_VISITS + 1)
    a = np.array([x[known & (visit == v)].mean() for v in numbers])
    b = np.array([y[known & (visit == v)].mean() for v in numbers])
    a, b = a - a.mean(), b - b.mean()
    xx, xy, yy = float(a @ a), float(a @ b), float(b @ b)
    if not _varies(x[known], np.array([xx])) or not _varies(y[known], np.array([yy])):
        return Unavailable(Reason.ALL_EQUAL)
    slope, r = xy / xx, xy / np.sqrt(xx * yy)
    error = float(np.sqrt(max(yy - slope * xy, 1e-15 * yy) / (n - 2) / xx))
    q = float(stdtrit(n - 2, (1 + level) / 2))
    z, half = _fisher(r), q / np.sqrt(n - 3)
    p = 2 * float(stdtr(n - 2, -abs(slope) / error))
    ends = slope - q * error, slope + q * error
    return Association(slope, *ends, level, p, float(r), float(np.tanh(z - half)), float(np.tanh(z + half)), n, sessions)


def _jackknife(total: Floats, without: Floats, visits: int, sessions: int, level: float) -> Association | Unavailable:
    """Compute slope and correlation of sums (xx, xy, yy), with intervals from the sums without each visit."""
    if (without[:, [0, 2]] <= 1e-12 * total[[0, 2]]).any():
        return Unavailable(Reason.ONE_VISIT)
    slope, slopes = total[1] / total[0], without[:, 1] / without[:, 0]
    z = _fisher(total[1] / np.sqrt(total[0] * total[2]))
    zs = _fisher(without[:, 1] / np.sqrt(without[:, 0] * without[:, 2]))
    errors = [float(np.sqrt((visits - 1) / visits * np.sum((v - v.mean()) ** 2))) for v in (slopes, zs)]
    if errors[0] <= 1e-12 * abs(slope):
        return Unavailable(Reason.NO_VARIANCE)
    # Visits in which x hardly varies contribute little: the effective number of visits is that of equal shares of the spread of x. In
    # simulations visits - 1 degrees covered .92-.95, effective visits - 1 .96-.99, their mean .94-.965.
    share = (total[0] - without[:, 0]) / total[0]
    degrees = (visits - 1 + max(1 / float(share @ share) - 1, 1.0)) / 2
    q = float(stdtrit(degrees, (1 + level) / 2))
    p = 2 * float(stdtr(degrees, -abs(slope) / errors[0]))
    half = q * errors[1]
    ends = float(slope - q * errors[0]), float(slope + q * errors[0])
    r, low, high = np.tanh(np.array([z, z - half, z + half])).tolist()
    return Association(float(slope), *ends, level, p, r, low, high, visits, sessions)


def _fisher(r: Floats | float) -> Floats:
    return np.arctanh(np.clip(r, -1 + 1e-12, 1 - 1e-12))


def _varies(values: Floats, squares: Floats) -> bool:
    return float(squares.sum()) > 1e-20 * max(1.0, float(np.abs(values).max()) ** 2) * values.size


def _check(x: Floats, y: Floats, visit: Integers, level: float) -> None:
    if not x.shape == y.shape == visit.shape:
        raise ValueError(f"x, y and visit need one entry per session each, not shapes {x.shape}, {y.shape}, {visit.shape}")
    if np.isinf(x).any() or np.isinf(y).any():
        raise ValueError("an infinite value was given: leave it out, or give NaN where nothing was measured")
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval must be between 0 and 1, not {level}")
