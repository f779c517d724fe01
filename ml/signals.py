"""Beta amplitude from local field potentials, and averages per step of streams with gaps. P_beta: Gao et al. 2023, section 3.

Row i of every result covers (t0 + i * period, t0 + (i + 1) * period]. Gaps are never bridged: a stretch of samples without a gap is
filtered by itself, and a row that holds too few samples is NaN.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt, welch

FILTER_ORDER = 4
MIN_CYCLES = 3.0
"""A gap-free stretch shorter than this many cycles of the lower band edge says nothing about the band and is not counted."""

EDGE_CYCLES = 2.0
"""Length of the odd mirror image put before and after a stretch, in cycles of the lower edge."""

SEGMENTS_AT_ONCE = 512
"""Segments of a spectrum that are transformed together, so that a recording of hours needs no multiple of itself in memory."""


@dataclass(frozen=True, slots=True)
class BandRows:
    """Band amplitude per row, all shape [rows].

    Attributes:
        rms: root mean square of the band-passed signal, unit of the samples; NaN where the row holds no usable sample.
        power: its square.
        covered: share of the row that usable samples cover, 0..1.
    """

    rms: NDArray[np.float64]
    power: NDArray[np.float64]
    covered: NDArray[np.float64]


def band_pass(samples: NDArray[np.float64], rate_hz: float, low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Zero-phase Butterworth band-pass of one gap-free stretch, -3 dB at the edges after both passes.

    Args:
        samples: shape [n].
        rate_hz: samples per second.
        low_hz, high_hz: band edges, 0 < low < high < rate / 2.

    Returns:
        Shape [n], same unit.

    Raises:
        ValueError: a band outside (0, rate / 2).
    """
    if not 0 < low_hz < high_hz < rate_hz / 2:
        raise ValueError(f"a band of {low_hz:g} to {high_hz:g} Hz does not fit below half of {rate_hz:g} Hz")
    sections = _sections(rate_hz, low_hz, high_hz)
    pad = min(samples.size - 1, round(EDGE_CYCLES * rate_hz / low_hz))
    return np.asarray(sosfiltfilt(sections, samples, padlen=pad), dtype=np.float64)


@lru_cache(maxsize=64)
def _sections(rate_hz: float, low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Second-order sections of one pass; kept, because a lossy recording has hundreds of stretches and one filter."""
    edges = _edges_of_one_pass(rate_hz, low_hz, high_hz)
    return np.asarray(butter(FILTER_ORDER, edges, btype="bandpass", fs=rate_hz, output="sos"))


def _edges_of_one_pass(rate_hz: float, low_hz: float, high_hz: float) -> tuple[float, float]:
    """Edges of a filter that is -1.5 dB at the wanted ones, so that two passes are -3 dB there and the noise bandwidth is the band's.

    The band is widened about its geometric centre in the analogue prototype, by (sqrt(2) - 1)^(-1 / 2N) for order N.
    """
    low, high = (np.tan(np.pi * edge / rate_hz) for edge in (low_hz, high_hz))
    half = (high - low) / (2.0 * (np.sqrt(2.0) - 1.0) ** (1.0 / (2 * FILTER_ORDER)))
    centre = np.sqrt(half**2 + low * high)
    first, last = np.arctan([centre - half, centre + half]) * rate_hz / np.pi
    return float(first), float(last)


def band_rows(
    stretches: Iterable[tuple[float, float, NDArray[np.float64]]],
    rows: int,
    period_s: float,
    low_hz: float,
    high_hz: float,
    t0_s: float = 0.0,
) -> BandRows:
    """Band amplitude of a lossy signal per row.

    Args:
        stretches: gap-free pieces (time of the first sample in s, rate in Hz, samples [n]), in any order; rates may differ.
        rows: number of rows.
        period_s: length of a row, s.
        low_hz, high_hz: band edges, Hz.
        t0_s: where row 0 begins.

    Raises:
        ValueError: a band outside (0, rate / 2) of a stretch.
    """
    energy = np.zeros(rows)
    seconds = np.zeros(rows)
    for start_s, rate_hz, samples in stretches:
        if samples.size < MIN_CYCLES * rate_hz / low_hz:
            continue
        filtered = band_pass(samples, rate_hz, low_hz, high_hz)
        row = row_of(start_s + np.arange(samples.size) / rate_hz - t0_s, period_s)
        inside = (row >= 0) & (row < rows)
        energy += np.bincount(row[inside], weights=filtered[inside] ** 2 / rate_hz, minlength=rows)
        seconds += np.bincount(row[inside], minlength=rows) / rate_hz
    with np.errstate(invalid="ignore", divide="ignore"):
        power = np.where(seconds > 0, energy / seconds, np.nan)
    return BandRows(np.sqrt(power), power, np.minimum(seconds / period_s, 1.0))


def row_of(t_s: NDArray[np.float64], period_s: float) -> NDArray[np.int64]:
    """Row that holds each time; rows are open on the left and closed on the right, except that 0 belongs to row 0. Shape as t_s."""
    row = np.ceil(t_s / period_s - 1e-9).astype(np.int64) - 1
    return np.where((row == -1) & (t_s > -1e-9), 0, row)


def row_means(
    t_s: NDArray[np.float64], values: NDArray[np.float64], interval_s: NDArray[np.float64], rows: int, period_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean per row of values that come at intervals, such as the device's own band power.

    Args:
        t_s: time of each value, [n]; values with NaN are gaps.
        values: [n].
        interval_s: time each value stands for, [n].
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


def step_means(
    t_s: NDArray[np.float64], values: NDArray[np.float64], end_s: float, rows: int, period_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Time-weighted mean per row of a value that holds from its time until the next, such as the stimulation amplitude.

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


def spectrum(
    stretches: Iterable[tuple[float, float, NDArray[np.float64]]], max_hz: float = 100.0, segment_s: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Power spectral density of a lossy signal: Welch's method within each gap-free stretch, averaged over all segments.

    Hann windows of `segment_s` that overlap by half, each freed of its mean, one-sided; the integral over frequency is the variance.
    Source: Welch 1967, IEEE Trans. Audio Electroacoust. 15, 70-73. Stretches shorter than a segment are left out.

    Args:
        stretches: gap-free pieces (time of the first sample in s, rate in Hz, samples [n]), as in `band_rows`; rates may differ.
        max_hz: highest frequency wanted. Above half of the highest rate there is none.
        segment_s: length of a segment, s; the frequencies are 1 / segment_s apart.

    Returns:
        Frequencies in Hz [n], density in the samples' unit squared per Hz [n], and the seconds of signal that it rests on. All empty, and
        0 s, where no stretch is as long as a segment. A frequency above half the rate of some stretches rests on the others alone.
    """
    grid = np.arange(int(np.floor(max_hz * segment_s + 1e-9)) + 1) / segment_s
    total = np.zeros(grid.size)
    segments = np.zeros(grid.size)
    seconds = 0.0
    for _, rate_hz, samples in stretches:
        width = round(segment_s * rate_hz)
        if width < 2 or samples.size < width:
            continue
        hop = width - width // 2
        count = (samples.size - width) // hop + 1
        seconds += ((count - 1) * hop + width) / rate_hz
        for first in range(0, count, SEGMENTS_AT_ONCE):
            here = min(SEGMENTS_AT_ONCE, count - first)
            block = samples[first * hop : (first + here - 1) * hop + width]
            hz, density = welch(block, rate_hz, nperseg=width, noverlap=width - hop)
            reached = grid <= hz[-1] + 1e-9
            # a rate that gives no whole number of samples per segment has its frequencies a little beside the grid
            total[reached] += here * np.interp(grid[reached], hz, density)
            segments[reached] += here
    known = segments > 0
    return grid[known], total[known] / segments[known], seconds
