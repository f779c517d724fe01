"""Samples at the resolution of a screen: extremes per bin of time in several widths, and power over time and frequency.

A recording of a million samples cannot be sent to a page. A bin's lowest and highest sample show what a line through every sample would
show at that width, so that no spike is lost. Bins without a sample stay empty, so that gaps stay gaps.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FIRST = 8
"""Samples in a bin of the finest level."""

FACTOR = 4
"""How many bins of a level make one of the next."""

SEGMENTS_AT_ONCE = 512
"""Segments of a spectrogram that are transformed together."""

Stretch = tuple[float, float, NDArray[np.floating]]
"""A gap-free piece: time of its first sample in s, rate in Hz, samples [n]."""


@dataclass(frozen=True, eq=False)
class Level:
    """Extremes per bin: bin i covers [first_s + i * width_s, first_s + (i + 1) * width_s).

    Attributes:
        low, high: lowest and highest sample, float32 [n], unit of the samples; NaN in a bin without a sample.
    """

    first_s: float
    width_s: float
    low: NDArray[np.float32]
    high: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Spectrogram:
    """Power over time and frequency.

    Attributes:
        first_s, width_s: where column 0 begins, and how much time a column covers, s.
        hz: frequencies, [m]. density: float32 [columns, m], unit of the samples squared per Hz; NaN in a column without a whole segment.
    """

    first_s: float
    width_s: float
    hz: NDArray[np.float64]
    density: NDArray[np.float32]


def pyramid(t_s: NDArray[np.float64], values: NDArray[np.float32], rate_hz: float) -> list[Level]:
    """Compute levels of extremes, each `FACTOR` times as wide as the one before, down to a single bin.

    Args:
        t_s: times of the samples, s, [n], in any order. values: samples, [n]. rate_hz: the highest rate of the samples.

    Returns:
        The finest first; empty where there is no sample.
    """
    if values.size == 0:
        return []
    order = np.argsort(t_s, kind="stable")
    t_s, values = t_s[order], values[order]
    width = FIRST / rate_hz
    first = float(t_s[0])
    bins = np.floor((t_s - first) / width + 1e-6).astype(np.int64)
    begins = np.flatnonzero(np.r_[True, np.diff(bins) > 0])
    low, high = np.full(int(bins[-1]) + 1, np.nan, np.float32), np.full(int(bins[-1]) + 1, np.nan, np.float32)
    low[bins[begins]] = np.minimum.reduceat(values, begins)
    high[bins[begins]] = np.maximum.reduceat(values, begins)
    levels = [Level(first, width, low, high)]
    while levels[-1].low.size > 1:
        levels.append(_wider(levels[-1]))
    return levels


def _wider(level: Level) -> Level:
    short = -level.low.size % FACTOR
    pad = np.full(short, np.nan, np.float32)
    # fmin and fmax take the number where the other is NaN: only a bin without any sample stays empty
    low = np.fmin.reduce(np.r_[level.low, pad].reshape(-1, FACTOR), axis=1)
    high = np.fmax.reduce(np.r_[level.high, pad].reshape(-1, FACTOR), axis=1)
    return Level(level.first_s, FACTOR * level.width_s, low, high)


def level_for(levels: Sequence[Level], begin_s: float, end_s: float, bins: int) -> int | None:
    """Find the coarsest level that draws a window in at least `bins` bins; None where only the samples themselves do."""
    for number in range(len(levels) - 1, -1, -1):
        if levels[number].width_s * bins <= end_s - begin_s:
            return number
    return None


def spectrogram(
    stretches: Iterable[Stretch], begin_s: float, end_s: float, width_s: float = 1.0, max_hz: float = 100.0, segment_s: float = 1.0
) -> Spectrogram:
    """Estimate the power spectral density per column of time: Hann windows that overlap by half, each freed of its mean, one-sided.

    A segment counts in the column of its middle. The density of a column is the mean of its segments, as in Welch 1967, IEEE Trans. Audio
    Electroacoust. 15, 70-73. No segment reaches over a gap.

    Args:
        stretches: gap-free pieces; rates may differ.
        begin_s, end_s: what the columns cover. width_s: of a column.
        max_hz: highest frequency wanted. segment_s: length of a segment; frequencies are 1 / segment_s apart.

    Returns:
        Frequencies that no stretch reaches are omitted.
    """
    columns = max(1, int(np.ceil((end_s - begin_s) / width_s - 1e-9)))
    grid = np.arange(int(np.floor(max_hz * segment_s + 1e-9)) + 1) / segment_s
    total = np.zeros((columns, grid.size))
    counts = np.zeros((columns, grid.size))
    for start_s, rate_hz, samples in stretches:
        width = round(segment_s * rate_hz)
        if width < 4 or samples.size < width:
            continue
        hop = width - width // 2
        frames = np.lib.stride_tricks.sliding_window_view(np.asarray(samples, np.float64), width)[::hop]
        window = np.hanning(width + 1)[:-1]
        hz = np.fft.rfftfreq(width, 1 / rate_hz)
        reached = grid <= hz[-1] + 1e-9
        middles = start_s + (np.arange(frames.shape[0]) * hop + width / 2) / rate_hz
        column = np.floor((middles - begin_s) / width_s).astype(np.int64)
        for first in range(0, frames.shape[0], SEGMENTS_AT_ONCE):
            block = frames[first : first + SEGMENTS_AT_ONCE]
            power = np.abs(np.fft.rfft((block - block.mean(axis=1, keepdims=True)) * window, axis=1)) ** 2
            power *= 2.0 / (rate_hz * np.sum(window**2))
            power[:, 0] /= 2
            if width % 2 == 0:
                power[:, -1] /= 2
            if not np.array_equal(hz[: grid.size], grid[: hz.size]):
                # a rate that gives no whole number of samples per segment has its frequencies a little off the grid
                power = np.stack([np.interp(grid[reached], hz, row) for row in power])
            at = column[first : first + block.shape[0]]
            inside = (at >= 0) & (at < columns)
            np.add.at(total, at[inside], np.pad(power[inside][:, : reached.sum()], ((0, 0), (0, grid.size - int(reached.sum())))))
            np.add.at(counts, at[inside], reached.astype(np.float64))
    known = counts.any(axis=0)
    with np.errstate(invalid="ignore"):
        density = np.where(counts > 0, total / counts, np.nan)[:, known].astype(np.float32)
    return Spectrogram(begin_s, width_s, grid[known], density)


def fewer_columns(found: Spectrogram, begin_s: float, end_s: float, most: int) -> Spectrogram:
    """Average the columns of a window so that there are at most `most`; a column without any power stays empty."""
    first = max(0, int(np.floor((begin_s - found.first_s) / found.width_s + 1e-9)))
    last = min(found.density.shape[0], int(np.ceil((end_s - found.first_s) / found.width_s - 1e-9)))
    rows = found.density[first : max(last, first)]
    together = max(1, -(-rows.shape[0] // most))
    short = -rows.shape[0] % together
    blocks = np.concatenate([rows, np.full((short, rows.shape[1]), np.nan, rows.dtype)]).reshape(-1, together, rows.shape[1])
    counts = np.sum(~np.isnan(blocks), axis=1)
    with np.errstate(invalid="ignore"):
        mean = np.where(counts > 0, np.nansum(blocks, axis=1) / counts, np.nan)
    return Spectrogram(found.first_s + first * found.width_s, together * found.width_s, found.hz, mean.astype(np.float32))
