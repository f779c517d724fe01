"""Beta amplitude from local field potentials, and averages per step of streams with gaps. P_beta: Gao et al. 2023, section 3.

Row i of every result covers (t0 + i * period, t0 + (i + 1) * period]. Short gaps are predicted for the filter alone: only samples that
were measured are scored, and a row without one is NaN.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from ml.signals.prediction import Model, fit, predict, unsaid
from ml.signals.rows import row_of

FILTER_ORDER = 4
MIN_CYCLES = 3.0
"""A run with fewer samples than this many cycles of the lower band edge says nothing about the band and is not counted."""

BRIDGE_S = 1.0
"""Longest gap over which the filter continues; at the edges of a longer one it starts again."""

RESPONSE_CYCLES = 8.0
"""Half length of the filter's impulse response that counts, in cycles of the band's width."""

LEAST_PASSED = 1e-3
"""Floor of the share of a band's power that reaches a sample between two gaps; guards against rounding alone."""

BIN_S = 0.01
MAX_BINS = 400
"""Length of the pieces in which a row's standard error looks at what is missing, and the most of them per row."""

MAX_LAG_S = 1.0
"""Band-passed samples further apart than this are taken as independent."""

ROWS_PER_PRODUCT = 2048

EDGE_CYCLES = 2.0
"""Length of the odd mirror image put before and after a stretch, in cycles of the lower edge."""

SEGMENTS_AT_ONCE = 512
"""Segments of a spectrum that are transformed together, so that a recording of hours needs no multiple of itself in memory."""


Stretch = tuple[float, float, NDArray[np.float64]]
"""A gap-free piece: time of its first sample in s, rate in Hz, samples [n]."""


@dataclass(frozen=True, slots=True)
class BandRows:
    """Band amplitude per row, all shape [rows].

    Attributes:
        rms: root mean square of the band-passed signal, unit of the samples; NaN where the row holds no usable sample.
        power: its square.
        covered: share of the row that usable samples cover, 0..1.
        rms_error: standard error of `rms` as a measure of the whole row, for what is missing of it; 0 in a whole row, NaN where `rms` is.
        sample: share of a row that one sample covers, of the slowest rate; a number.
    """

    rms: NDArray[np.float64]
    power: NDArray[np.float64]
    covered: NDArray[np.float64]
    rms_error: NDArray[np.float64]
    sample: float = 0.0

    @property
    def reached(self) -> NDArray[np.float64]:
        """Covered share for comparison with a limit: `covered`, and one sample more.

        Rows begin and end between samples. So a row that packets fill to an exact share has one sample more or one less.
        """
        return np.minimum(self.covered + self.sample, 1.0)

    @property
    def power_error(self) -> NDArray[np.float64]:
        """Standard error of `power`, to first order."""
        return 2.0 * self.rms * self.rms_error


def band_pass(samples: NDArray[np.float64], rate_hz: float, low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Apply a zero-phase Butterworth band-pass to one gap-free stretch, -3 dB at the edges after both passes.

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
    return np.asarray(scipy.signal.sosfiltfilt(sections, samples, padlen=pad), dtype=np.float64)


@lru_cache(maxsize=64)
def _sections(rate_hz: float, low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Design the second-order sections of one pass. They are cached: a lossy recording has hundreds of stretches and one filter."""
    edges = _edges_of_one_pass(rate_hz, low_hz, high_hz)
    return np.asarray(scipy.signal.butter(FILTER_ORDER, edges, btype="bandpass", fs=rate_hz, output="sos"))


def _edges_of_one_pass(rate_hz: float, low_hz: float, high_hz: float) -> tuple[float, float]:
    """Compute the edges of a filter that is -1.5 dB at the wanted ones. Two passes are then -3 dB there, and the noise bandwidth is the
    band's.

    The band is widened about its geometric centre in the analogue prototype, by (sqrt(2) - 1)^(-1 / 2N) for order N.
    """
    low, high = (np.tan(np.pi * edge / rate_hz) for edge in (low_hz, high_hz))
    half = (high - low) / (2.0 * (np.sqrt(2.0) - 1.0) ** (1.0 / (2 * FILTER_ORDER)))
    centre = np.sqrt(half**2 + low * high)
    first, last = np.arctan([centre - half, centre + half]) * rate_hz / np.pi
    return float(first), float(last)


def band_rows(
    stretches: Iterable[Stretch],
    rows: int,
    period_s: float,
    low_hz: float,
    high_hz: float,
    t0_s: float = 0.0,
    models: Mapping[float, Model | None] | None = None,
) -> BandRows:
    """Compute the band amplitude of a lossy signal per row.

    Stretches of one rate with at most `BRIDGE_S` between them are filtered as one. An autoregressive model of the measured samples fills
    the gaps, predicting from both sides (`ml.signals.prediction`). Where there is no model, straight lines do. Only measured samples count.
    Near a gap the filter lacks what the prediction does not know. So the sum of squares is divided by the share of the band's power that
    reaches each sample, by the model. Without a model the band counts as flat; without gaps the divisor is the number of samples.

    The standard error of a row is that of its power against the mean over the whole row. The signal counts as Gaussian, with a band-passed
    autocorrelation rho, that of the measured samples. A sample of which the share g is passed is sqrt(g) of the signal and lacks an
    independent sqrt(1 - g). By the covariance of squares (Isserlis 1918, Biometrika 12, 134-139),
    var / power^2 = sum_ij (d_i d_j + 2 c_i c_j) 2 rho_ij^2, with d = g / sum(g) - 1 / n and c = sqrt(g (1 - g)) / n.

    Args:
        stretches: gap-free pieces, in any order, not overlapping; rates may differ.
        rows: number of rows.
        period_s: length of a row, s.
        low_hz, high_hz: band edges, Hz.
        t0_s: where row 0 begins.
        models: what fills the gaps, by rate, where the stretches are a part of a longer signal; of the stretches, where not given.

    Raises:
        ValueError: a band outside (0, rate / 2) of a stretch.
    """
    by_rate = _by_rate(stretches)
    known = _models(by_rate) if models is None else models
    bins = min(MAX_BINS, max(1, round(period_s / BIN_S)))
    energy, seconds = np.zeros(rows), np.zeros(rows)
    passed, mixed = np.zeros(rows * bins), np.zeros(rows * bins)
    lags_s = period_s / bins * np.arange(bins, dtype=np.float64)
    squared, weight = np.zeros(bins), 0.0
    for run in _runs(by_rate, known, low_hz):
        if run.measured.sum() < MIN_CYCLES * run.rate_hz / low_hz:
            continue
        filtered = band_pass(run.bridged, run.rate_hz, low_hz, high_hz)[run.measured]
        share = _passed_share(run, low_hz, high_hz)
        piece = row_of(run.t_s - t0_s, period_s / bins)
        inside = (piece >= 0) & (piece < rows * bins)
        row = piece[inside] // bins
        energy += np.bincount(row, weights=filtered[inside] ** 2 / run.rate_hz, minlength=rows)
        seconds += np.bincount(row, minlength=rows) / run.rate_hz
        passed += np.bincount(piece[inside], weights=share[inside] / run.rate_hz, minlength=rows * bins)
        mixed += np.bincount(piece[inside], weights=np.sqrt(share * (1 - share))[inside] / run.rate_hz, minlength=rows * bins)
        squared += filtered.size / run.rate_hz * _squared_correlation(run, filtered, lags_s)
        weight += filtered.size / run.rate_hz
    by_bin = passed.reshape(rows, bins)
    correlation = squared / weight if weight else squared
    with np.errstate(invalid="ignore", divide="ignore"):
        power = np.where(seconds > 0, energy / by_bin.sum(axis=1), np.nan)
    rms = np.sqrt(power)
    error = 0.5 * rms * _relative_error(by_bin, mixed.reshape(rows, bins), correlation, period_s)
    return BandRows(rms, power, np.minimum(seconds / period_s, 1.0), error, one_sample(by_rate, period_s))


def one_sample(rates_hz: Iterable[float], period_s: float) -> float:
    """Compute the share of a row that one sample of the slowest of these rates covers; 0 without a rate."""
    return 1.0 / (min(rates_hz, default=math.inf) * period_s)


@dataclass(frozen=True, slots=True)
class _Run:
    """Stretches of one rate without a long gap between them.

    Attributes:
        rate_hz: samples per second.
        bridged: samples with the gaps filled, [m].
        measured: which of them were measured, [m].
        t_s: times of the measured ones, [n].
        model: what filled the gaps; None: straight lines.
    """

    rate_hz: float
    bridged: NDArray[np.float64]
    measured: NDArray[np.bool_]
    t_s: NDArray[np.float64]
    model: Model | None


def gap_models(stretches: Iterable[Stretch]) -> dict[float, Model | None]:
    """Fit the models that fill a signal's gaps, by the rate of its stretches; None where straight lines fill them."""
    return _models(_by_rate(stretches))


def _models(by_rate: Mapping[float, list[Stretch]]) -> dict[float, Model | None]:
    # a single stretch has no gap to fill
    return {
        rate_hz: fit([(p, s[2]) for p, s in zip(_places(own, rate_hz), own, strict=True)], rate_hz) if len(own) > 1 else None
        for rate_hz, own in by_rate.items()
    }


def _by_rate(stretches: Iterable[Stretch]) -> dict[float, list[Stretch]]:
    """Sort stretches with samples by their rate and by time."""
    by_rate: dict[float, list[Stretch]] = defaultdict(list)
    for stretch in stretches:
        if stretch[2].size:
            by_rate[stretch[1]].append(stretch)
    return {rate_hz: sorted(own, key=lambda s: s[0]) for rate_hz, own in by_rate.items()}


def _places(stretches: Sequence[Stretch], rate_hz: float) -> list[int]:
    """Find the nearest place of each stretch's first sample on the grid of its rate, after the samples before it."""
    places: list[int] = []
    end = -np.inf
    for start_s, _, samples in stretches:
        places.append(int(max(np.rint(start_s * rate_hz), end)))
        end = places[-1] + samples.size
    return places


def _runs(by_rate: Mapping[float, list[Stretch]], models: Mapping[float, Model | None], low_hz: float) -> Iterator[_Run]:
    """Yield runs of stretches of one rate, each stretch at its nearest place on the grid of that rate."""
    for rate_hz, own in by_rate.items():
        together: list[Stretch] = []
        end_s = -np.inf
        for stretch in own:
            if together and stretch[0] - end_s > BRIDGE_S:
                yield _run(rate_hz, together, models.get(rate_hz), low_hz)
                together = []
            together.append(stretch)
            end_s = max(end_s, stretch[0] + stretch[2].size / rate_hz)
        yield _run(rate_hz, together, models.get(rate_hz), low_hz)


def _run(rate_hz: float, stretches: list[Stretch], model: Model | None, low_hz: float) -> _Run:
    places = _places(stretches, rate_hz)
    index = np.concatenate([p - places[0] + np.arange(s[2].size) for p, s in zip(places, stretches, strict=True)])
    samples = np.concatenate([s[2] for s in stretches])
    t_s = np.concatenate([s[0] + np.arange(s[2].size) / rate_hz for s in stretches])
    measured = np.zeros(int(index[-1]) + 1, dtype=bool)
    measured[index] = True
    bridged = np.zeros(measured.size)
    bridged[index] = samples
    if model is None:
        _bridge(bridged, measured, max(1, round(rate_hz / low_hz)))
    elif not measured.all():
        bridged = predict(model, bridged, measured)
    return _Run(rate_hz, bridged, measured, t_s, model)


def _bridge(x: NDArray[np.float64], measured: NDArray[np.bool_], cycle: int) -> None:
    """Fill the gaps of x, [m], with straight lines between the means of up to `cycle` samples on either side.

    A mean over a cycle follows the slow background. It follows neither the band nor the noise, which a line from sample to sample would
    add.
    """
    edges = np.flatnonzero(np.diff(np.concatenate(([0], measured.astype(np.int8), [0]))))
    begin, end = edges[::2], edges[1::2]
    width = np.minimum(cycle, end - begin)
    total = np.concatenate(([0.0], np.cumsum(x)))
    head, tail = (total[begin + width] - total[begin]) / width, (total[end] - total[end - width]) / width
    # the lines run between the middles of the means
    middles = np.stack([begin + (width - 1) / 2, end - 1 - (width - 1) / 2], axis=1).ravel()
    gap = np.flatnonzero(~measured)
    x[gap] = np.interp(gap, middles, np.stack([head, tail], axis=1).ravel())


def _passed_share(run: _Run, low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Compute the share of the band's power that reaches each measured sample, 0..1; 1 far from gaps. Beyond the run's ends nothing is
    missing."""
    if run.measured.all():
        return np.ones(run.t_s.size)
    impulse = _impulse_response(run.rate_hz, low_hz, high_hz)
    if run.model is not None:
        return np.clip(1.0 - unsaid(run.model, run.measured, impulse)[run.measured], LEAST_PASSED, 1.0)
    response = impulse**2 / np.sum(impulse**2)
    around = np.pad(run.measured.astype(np.float64), response.size // 2, constant_values=1.0)
    return np.clip(scipy.signal.fftconvolve(around, response, mode="valid")[run.measured], LEAST_PASSED, 1.0)


@lru_cache(maxsize=64)
def _impulse_response(rate_hz: float, low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Compute the zero-phase filter's impulse response about its middle, as far as it counts."""
    half = int(np.ceil(RESPONSE_CYCLES * rate_hz / (high_hz - low_hz)))
    impulse = np.zeros(2 * half + 1)
    impulse[half] = 1.0
    return band_pass(impulse, rate_hz, low_hz, high_hz)


def _squared_correlation(run: _Run, filtered: NDArray[np.float64], lags_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the square of the measured samples' autocorrelation, averaged over the lags around each of `lags_s`; same shape."""
    most = min(int(MAX_LAG_S * run.rate_hz), run.measured.size - 1)
    length = scipy.fft.next_fast_len(run.measured.size + most + 1, real=True)
    signal, mask = np.zeros(run.measured.size), run.measured.astype(np.float64)
    signal[run.measured] = filtered
    products, pairs = (scipy.fft.irfft(np.abs(scipy.fft.rfft(x, length)) ** 2, length)[: most + 1] for x in (signal, mask))
    if products[0] <= 0:
        return np.zeros(lags_s.size)
    # the same denominator at every lag but for the pairs that gaps leave: an estimate from few pairs is drawn to 0
    rho = products / products[0] * pairs[0] / np.maximum(pairs, 0.5 * pairs[0])
    width = lags_s[1] if lags_s.size > 1 else 2 * MAX_LAG_S
    lag = np.arange(most + 1) / run.rate_hz
    integral = np.concatenate(([0.0], np.cumsum(np.clip(rho, -1.0, 1.0) ** 2))) / run.rate_hz
    edges = np.append(lag - 0.5 / run.rate_hz, lag[-1] + 0.5 / run.rate_hz)
    between = lags_s[:, None] + width * np.array([-0.5, 0.5])
    # lags are symmetric: the left of 0 is the mirror image of the right
    value = np.sign(between) * np.interp(np.abs(between), edges, integral - 0.5 / run.rate_hz)
    return np.asarray(np.maximum(np.diff(value, axis=1)[:, 0] / width, 0.0))


def _relative_error(
    passed: NDArray[np.float64], mixed: NDArray[np.float64], squared: NDArray[np.float64], period_s: float
) -> NDArray[np.float64]:
    """Compute the standard error of each row's mean power over that power, [rows].

    Args:
        passed, mixed: sums of g and of sqrt(g (1 - g)) over the samples of each piece of a row, s, [rows, bins].
        squared: rho^2 by the distance of two pieces, [bins].
        period_s: length of a row, s.
    """
    covariance = 2.0 * scipy.linalg.toeplitz(squared)
    in_row = passed.sum(axis=1)
    out = np.where(in_row > 0, 0.0, np.nan)
    partly = np.flatnonzero((in_row > 0) & (in_row < period_s * (1 - 1e-6)))
    for first in range(0, partly.size, ROWS_PER_PRODUCT):
        some = partly[first : first + ROWS_PER_PRODUCT]
        weights = passed[some] / in_row[some, None] - 1.0 / passed.shape[1]
        lost = np.sqrt(2.0) * mixed[some] / period_s
        variance = sum(np.einsum("ri,ri->r", w @ covariance, w) for w in (weights, lost))
        out[some] = np.sqrt(np.maximum(variance, 0.0))
    return out


def spectrum(
    stretches: Iterable[tuple[float, float, NDArray[np.float64]]], max_hz: float = 100.0, segment_s: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Estimate the power spectral density of a lossy signal: Welch's method within each gap-free stretch, averaged over all segments.

    Hann windows of `segment_s` overlap by half; each is freed of its mean. The density is one-sided, so its integral over frequency is the
    variance. Source: Welch 1967, IEEE Trans. Audio Electroacoust. 15, 70-73. Stretches shorter than a segment are excluded.

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
            hz, density = scipy.signal.welch(block, rate_hz, nperseg=width, noverlap=width - hop)
            reached = grid <= hz[-1] + 1e-9
            # a rate that gives no whole number of samples per segment has its frequencies a little off the grid
            total[reached] += here * np.interp(grid[reached], hz, density)
            segments[reached] += here
    known = segments > 0
    return grid[known], total[known] / segments[known], seconds
