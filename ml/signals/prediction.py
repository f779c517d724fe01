"""Prediction of a signal's missing samples by an autoregressive model, and the share of a band that it leaves unknown.

The best linear prediction from both sides minimises the model's squared residual over the missing samples (Janssen, Veldhuis and Vries
1986, IEEE Trans. ASSP 34, 317-330). With b the autocorrelation of the model's coefficients, the samples solve B x = -B' m. Here B and B'
contain b at the distances of missing samples to each other and to measured ones. Their covariance is the residual's variance times the
inverse of B.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

MEMORY_S = 0.1
"""How far back a sample is predicted from: two to three cycles of beta."""

SAMPLES_PER_COEFFICIENT = 40
"""Fewer measured samples per coefficient give no model."""

RIDGE = 1e-3
"""White noise that is added to a signal's power before its model is fitted, as a share: what amplifiers add, and a bound on resonance."""

BEYOND = 4
"""How many times its memory a signal is predicted on beyond its ends, until it has come back to its mean."""

MISSING_AT_ONCE = 4096
"""Missing samples that are solved for together, about, so that memory follows no length of a recording."""

SAMPLES_AT_ONCE = 65_536
"""Samples whose lagged products are summed together."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """An autoregressive model of a signal.

    Attributes:
        mean: of the measured samples.
        b: autocorrelation of the coefficients (1, -a_1, ..., -a_p) at lags 0 to p, [p + 1].
        residual: variance of what the model does not predict.
        coefficients: 1, -a_1, ..., -a_p, [p + 1].
    """

    mean: float
    b: Floats
    residual: float
    coefficients: Floats

    def scaled(self, factor: float) -> Model:
        """Convert the model to another unit, in which one old unit is `factor`."""
        return replace(self, mean=factor * self.mean, residual=factor**2 * self.residual)


def fit(pieces: Sequence[tuple[int, Floats]], rate_hz: float) -> Model | None:
    """Fit the model of a signal's measured samples by Yule and Walker; None where they are too few or constant.

    Args:
        pieces: place of the first sample on the grid of the rate and samples [n] of each gap-free piece, in order, not overlapping.
        rate_hz: samples per second.
    """
    order = round(MEMORY_S * rate_hz)
    measured = sum(x.size for _, x in pieces)
    if order < 1 or measured < SAMPLES_PER_COEFFICIENT * order:
        return None
    mean = sum(float(x.sum()) for _, x in pieces) / measured
    products, pairs = _lagged(pieces, mean, order)
    # few pairs of a lag draw it to 0
    r = products / np.maximum(pairs, 0.5 * pairs[0])
    if r[0] <= 0:
        return None
    r[0] *= 1.0 + RIDGE
    try:
        a = np.concatenate(([1.0], -scipy.linalg.solve_toeplitz(r[:-1], r[1:])))
    except np.linalg.LinAlgError:
        return None
    residual = float(a @ r)
    # gaps can make an autocovariance that no signal has
    if not (np.isfinite(a).all() and 0.0 < residual <= r[0]):
        return None
    return Model(mean, np.correlate(a, a, "full")[order:], residual, a)


def _lagged(pieces: Sequence[tuple[int, Floats]], mean: float, order: int) -> tuple[Floats, Floats]:
    """Sum the products of samples about the mean at lags 0 to `order`, and count the pairs of each lag; both [order + 1].

    A block of samples at a time, with those that the longest lag reaches back to, so that memory follows no length of a recording.
    """
    products, pairs = np.zeros(order + 1), np.zeros(order + 1)
    values, there, end = np.zeros(order), np.zeros(order), pieces[0][0]
    for place, samples in pieces:
        skipped = min(place - end, order)
        values, there = (np.concatenate((past[skipped:], np.zeros(skipped))) for past in (values, there))
        for first in range(0, samples.size, SAMPLES_AT_ONCE):
            x = samples[first : first + SAMPLES_AT_ONCE] - mean
            values, there = np.concatenate((values, x)), np.concatenate((there, np.ones(x.size)))
            products += np.correlate(values, x, "valid")[::-1]
            pairs += np.correlate(there, np.ones(x.size), "valid")[::-1]
            values, there = values[x.size :], there[x.size :]
        end = place + samples.size
    return products, pairs


def predict(model: Model, x: Floats, measured: NDArray[np.bool_]) -> Floats:
    """Predict the missing samples of a signal from both sides, [m].

    Args:
        model: of the signal.
        x: samples, [m]; those that are not measured are not looked at.
        measured: which were, [m].
    """
    order = model.b.size - 1
    # samples beyond the ends are missing too: taken as measured, they would draw gaps near an end to the mean
    beyond = BEYOND * order
    there = np.pad(measured, beyond)
    known = np.where(there, np.pad(x, beyond) - model.mean, 0.0)
    right = -scipy.signal.fftconvolve(known, np.concatenate((model.b[:0:-1], model.b)), mode="same")
    missing = np.flatnonzero(~there)
    out = known.copy()
    # gaps further apart than the model remembers have nothing to do with each other
    apart = np.flatnonzero(np.diff(missing) > order) + 1
    ends = [*apart.tolist(), missing.size]
    begin = 0
    for i, end in enumerate(ends):
        if end - begin < MISSING_AT_ONCE and i < len(ends) - 1:
            continue
        some = missing[begin:end]
        out[some] = _solve(model.b, some, right[some])
        begin = end
    return out[beyond : beyond + x.size] + model.mean


def _solve(b: Floats, missing: NDArray[np.int64], right: Floats) -> Floats:
    """Solve for the missing samples at these places, given the right-hand side of their equations."""
    order = min(b.size - 1, missing.size - 1)
    banded = np.zeros((order + 1, missing.size))
    for d in range(order + 1):
        distance = missing[d:] - missing[: missing.size - d]
        banded[d, : distance.size] = np.where(distance < b.size, b[np.minimum(distance, b.size - 1)], 0.0)
    return np.asarray(scipy.linalg.solveh_banded(banded, right, lower=True))


def unsaid(model: Model, measured: NDArray[np.bool_], impulse: Floats) -> Floats:
    """Compute the share of a filter's output power that the prediction of missing samples lacks at each sample, [m]; 0 far from gaps.

    The shares that two gaps lack are added, each as if the samples of the other were known. That is slightly too little where the gaps are
    less than half of the model's memory apart. At 250 Hz, it lacks 0.05 of the band's power for 6 samples between gaps of 30, up to 0.25
    for fewer.

    Args:
        model: of the signal.
        measured: which samples were measured, [m].
        impulse: the filter's impulse response, symmetric about its middle, [2 half + 1].
    """
    half = impulse.size // 2
    edges = np.flatnonzero(np.diff(np.concatenate(([1], measured.astype(np.int8), [1]))))
    lacking = np.zeros(measured.size + 2 * half)
    total = _power(model, impulse)
    profiles: dict[int, tuple[Floats, Floats]] = {}
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        size = min(end - begin, half)
        if size not in profiles:
            profiles[size] = _profile(model, size, impulse)
        before, behind = profiles[size]
        lacking[begin : begin + half] += before
        lacking[end + half : end + 2 * half] += behind
    return lacking[half : half + measured.size] / total


def _profile(model: Model, size: int, impulse: Floats) -> tuple[Floats, Floats]:
    """Compute the variance that a gap of so many samples leaves in the filter's output before and behind it, each [half].

    A gap longer than the filter is wide acts on either side as one of that length.
    """
    half = impulse.size // 2
    b = np.zeros(size)
    b[: min(size, model.b.size)] = model.b[:size]
    # y = h * e, where e has the covariance residual * inv(B) and B = L L'. Its variance is the residual times the squares of the columns of
    # inv(L) h.
    lower = scipy.linalg.cholesky(scipy.linalg.toeplitz(b), lower=True)
    places = np.concatenate((np.arange(-half, 0), np.arange(size, size + half)))
    distance = np.abs(places[:, None] - np.arange(size))
    weights = np.where(distance <= half, impulse[half + np.minimum(distance, half)], 0.0)
    lacking = model.residual * np.sum(scipy.linalg.solve_triangular(lower, weights.T, lower=True) ** 2, axis=0)
    return lacking[:half], lacking[half:]


def _power(model: Model, impulse: Floats) -> float:
    """Compute the power of the filter's output for a signal of this model."""
    length = scipy.fft.next_fast_len(4 * max(impulse.size, model.coefficients.size), real=True)
    density = model.residual / np.abs(scipy.fft.rfft(model.coefficients, length)) ** 2
    weight = np.abs(scipy.fft.rfft(impulse, length)) ** 2 * density
    whole = np.concatenate((weight, weight[1 : length - weight.size + 1]))
    return float(whole.mean())
