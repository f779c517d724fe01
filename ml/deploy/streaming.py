"""P_beta as it is known at the end of each period: the definition of `ml/signals` without the samples that are yet to come.

A period's value is the same zero-phase band-pass and the same root mean square over the same samples. It differs from the value that is
computed afterwards in four ways.
(1) The filter's right edge is at the last sample of the period, where it is mirrored, instead of in the samples that follow.
(2) Its left edge is `CONTEXT_S` before the period, instead of where the recording or a long gap left it.
(3) Samples that have just begun after a long gap are assessed by those that have come. So too few at the end of a period are not counted
there, though more follow.
(4) Short gaps are predicted from the samples of the context and the period alone. docs/deployment.md has the measured effect.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ml.signals import Stretch, band_rows

CONTEXT_S = 4.0
"""Samples before the period that the filter sees; 52 cycles of 13 Hz, after which it has forgotten where it began."""


class StreamingBeta:
    """P_beta period by period from samples as they come.

    Args:
        period_s: length of a period.
        low_hz, high_hz: band edges.
        min_valid_fraction: coverage: share of a period's samples below which it has no value; one sample less is enough.

    Raises:
        ValueError: a value outside its range.
    """

    def __init__(self, period_s: float, low_hz: float, high_hz: float, min_valid_fraction: float) -> None:
        if not (period_s > 0 and 0 < low_hz < high_hz and 0 < min_valid_fraction <= 1):
            raise ValueError(f"no P_beta from a period of {period_s} s, {low_hz} to {high_hz} Hz, {min_valid_fraction} of the samples")
        self._period_s, self._low_hz, self._high_hz, self._min_valid = period_s, low_hz, high_hz, min_valid_fraction
        self._pieces: list[Stretch] = []

    def add(self, start_s: float, rate_hz: float, samples: NDArray[np.float64]) -> None:
        """Take samples that have come, in order; a piece that goes on where the last one ended becomes one with it."""
        if samples.size == 0:
            return
        if self._pieces:
            first_s, rate, before = self._pieces[-1]
            if rate == rate_hz and abs(first_s + before.size / rate - start_s) < 0.5 / rate:
                self._pieces[-1] = (first_s, rate, np.concatenate([before, samples]))
                return
        self._pieces.append((start_s, rate_hz, samples))

    def value(self, end_s: float) -> float:
        """Compute P_beta of the period (end_s - period_s, end_s], unit of the samples; NaN where too few samples have come.

        Raises:
            ValueError: the band does not fit below half of a stretch's rate.
        """
        begin_s = end_s - self._period_s
        kept = [_cut_before(piece, begin_s - CONTEXT_S) for piece in self._pieces]
        self._pieces = [piece for piece in kept if piece[2].size]
        rows = band_rows(self._pieces, 1, self._period_s, self._low_hz, self._high_hz, t0_s=begin_s)
        enough = rows.reached[0] >= self._min_valid - 1e-9
        return float(rows.rms[0]) if enough else math.nan


def split_by_period(stretches: Sequence[Stretch], period_s: float, periods: int) -> Iterator[list[Stretch]]:
    """Split recorded stretches as they would have come: for each period (k, k + 1] its pieces, in order of time; samples up to 0 in the
    first."""
    arrivals: list[list[Stretch]] = [[] for _ in range(periods)]
    for start_s, rate_hz, samples in sorted(stretches, key=lambda piece: piece[0]):
        row = np.clip(np.ceil((start_s + np.arange(samples.size) / rate_hz) / period_s - 1e-9).astype(np.int64) - 1, 0, None)
        cuts = np.flatnonzero(np.diff(row)) + 1
        for first, end in zip([0, *cuts.tolist()], [*cuts.tolist(), samples.size], strict=True):
            if first < end and row[first] < periods:
                arrivals[row[first]].append((start_s + first / rate_hz, rate_hz, samples[first:end]))
    yield from arrivals


def _cut_before(piece: Stretch, t_s: float) -> Stretch:
    """Cut a stretch to the part from a time on."""
    start_s, rate_hz, samples = piece
    skip = max(0, math.ceil((t_s - start_s) * rate_hz))
    return start_s + skip / rate_hz, rate_hz, samples[skip:]
