"""Averages per step of streams with gaps: which row a time belongs to, and what a row holds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def row_of(t_s: NDArray[np.float64], period_s: float) -> NDArray[np.int64]:
    """Find the row of each time; rows are open on the left and closed on the right, except that 0 belongs to row 0. Shape as t_s."""
    row = np.ceil(t_s / period_s - 1e-9).astype(np.int64) - 1
    return np.where((row == -1) & (t_s > -1e-9), 0, row)


def row_means(
    t_s: NDArray[np.float64], values: NDArray[np.float64], interval_s: NDArray[np.float64], rows: int, period_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Average per row values that come at intervals, such as the device's own band power.

    Args:
        t_s: time of each value, [n]; values with NaN are gaps.
        values: [n].
        interval_s: time that each value covers, [n].
        rows: number of rows, the first beginning at 0.
        period_s: length of a row, s.

    Returns:
        Means [rows], NaN without a value, and the share of each row covered, 0..1.
    """
    row = row_of(t_s, period_s)
    use = np.isfinite(values) & (row >= 0) & (row < rows)
    total = np.bincount(row[use], weights=values[use] * interval_s[use], minlength=rows)
    seconds = np.bincount(row[use], weights=interval_s[use], minlength=rows)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(seconds > 0, total / seconds, np.nan), np.minimum(seconds / period_s, 1.0)


def interval_means(
    end_s: NDArray[np.float64], values: NDArray[np.float64], interval_s: float, rows: int, period_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Average per row, weighted by time, values that each cover the interval before their time, such as a power twice a second.

    Args:
        end_s: end of each value's interval, [n], increasing.
        values: [n]; values with NaN are gaps.
        interval_s: length of an interval; one that begins before the last has ended is cut there.
        rows: number of rows, the first beginning at 0.
        period_s: length of a row, s.

    Returns:
        Means [rows], NaN without a value, and the share of each row covered, 0..1.
    """
    begin_s = np.maximum(end_s - interval_s, np.concatenate(([-np.inf], end_s[:-1])))
    knots, levels = np.column_stack((begin_s, end_s)).ravel(), np.column_stack((values, np.full(values.size, np.nan))).ravel()
    return step_means(knots, levels, float(end_s[-1]) if end_s.size else 0.0, rows, period_s)


def step_means(
    t_s: NDArray[np.float64], values: NDArray[np.float64], end_s: float, rows: int, period_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Average per row, weighted by time, a value that applies until the next one, such as the stimulation amplitude.

    Args:
        t_s: when each value begins to hold, [n], not decreasing; may begin before 0.
        values: [n]; NaN where unknown.
        end_s: until when the last value holds, s.
        rows: number of rows, the first beginning at 0.
        period_s: length of a row, s.

    Returns:
        Means over the known part of each row [rows], NaN where nothing is known, and the known share of each row, 0..1.
    """
    if t_s.size == 0:
        return np.full(rows, np.nan), np.zeros(rows)
    edges = period_s * np.arange(rows + 1)
    knots = np.append(t_s, max(end_s, float(t_s[-1])))
    known = np.isfinite(values)
    held = np.diff(knots)
    integral = np.concatenate(([0.0], np.cumsum(np.where(known, values, 0.0) * held)))
    seconds = np.concatenate(([0.0], np.cumsum(np.where(known, held, 0.0))))
    area = np.diff(np.interp(edges, knots, integral))
    span = np.diff(np.interp(edges, knots, seconds))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(span > 1e-9, area / span, np.nan), np.clip(span / period_s, 0.0, 1.0)
