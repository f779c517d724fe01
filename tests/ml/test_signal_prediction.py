"""Missing samples as an autoregressive model predicts them, against closed forms and the dense conditional distribution."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from ml.signals import band_pass, band_rows, bands, prediction
from ml.signals.prediction import Model, fit, predict, unsaid

RATE = 250.0


def model_of(*a: float, residual: float = 1.0) -> Model:
    coefficients = np.array([1.0, *(-x for x in a)])
    return Model(0.0, np.correlate(coefficients, coefficients, "full")[coefficients.size - 1 :], residual, coefficients)


def rhythm(n: int, seed: int) -> np.ndarray:
    """Simulate beta of 5 Hz bandwidth on a background that falls with frequency, and white noise."""
    rng = np.random.default_rng(seed)
    beta = band_pass(rng.normal(size=n), RATE, 18.0, 23.0)
    slow = lfilter([1.0], [1.0, -0.97], rng.normal(size=n))
    return 1.5 * beta / beta.std() + slow / slow.std() + 0.3 * rng.normal(size=n)


def test_one_missing_sample_of_a_first_order_signal_is_the_closed_form() -> None:
    x, there = np.array([0.0, 2.0, 99.0, 1.0, 0.0]), np.array([True, True, False, True, True])
    a = 0.8
    assert predict(model_of(a), x, there)[2] == pytest.approx(a * (2.0 + 1.0) / (1 + a**2))


def test_gaps_are_filled_with_the_conditional_mean_of_the_model() -> None:
    model = model_of(1.2, -0.6)
    n = 60
    covariance = toeplitz(autocovariance((1.2, -0.6), n))
    there = np.ones(n, dtype=bool)
    there[[20, 21, 22, 24, 25, 40]] = False
    x = np.linalg.cholesky(covariance) @ np.random.default_rng(0).normal(size=n)
    known, missing = np.flatnonzero(there), np.flatnonzero(~there)
    expected = covariance[np.ix_(missing, known)] @ np.linalg.solve(covariance[np.ix_(known, known)], x[known])
    np.testing.assert_allclose(predict(model, x, there)[missing], expected, atol=1e-9)


def test_a_gap_near_an_end_is_not_drawn_to_the_mean_by_what_lies_beyond() -> None:
    n = 60
    covariance = toeplitz(autocovariance((1.2, -0.3), n))
    there = np.ones(n, dtype=bool)
    there[[1, 2, n - 4, n - 3, n - 2]] = False
    known, missing = np.flatnonzero(there), np.flatnonzero(~there)
    x = np.full(n, 600.0)
    expected = covariance[np.ix_(missing, known)] @ np.linalg.solve(covariance[np.ix_(known, known)], x[known])
    np.testing.assert_allclose(predict(model_of(1.2, -0.3), x, there)[missing], expected, rtol=0.01)


def test_pieces_have_the_products_of_the_signal_that_they_are_cut_from(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prediction, "SAMPLES_AT_ONCE", 700)
    x, there = rhythm(4000, 3), np.ones(4000, dtype=bool)
    there[[5, *range(900, 930), *range(935, 1400), 3998]] = False
    edges = np.flatnonzero(np.diff(np.concatenate(([0], there.astype(np.int8), [0]))))
    pieces = [(a, x[a:b]) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
    mean = x[there].mean()
    about, ones = np.where(there, x - mean, 0.0), there.astype(float)
    products, pairs = prediction._lagged(pieces, mean, 25)
    np.testing.assert_allclose(products, [about[k:] @ about[: about.size - k] for k in range(26)], rtol=1e-9)
    np.testing.assert_array_equal(pairs, [ones[k:] @ ones[: ones.size - k] for k in range(26)])


def autocovariance(a: tuple[float, ...], n: int) -> np.ndarray:
    """Compute the autocovariance of an autoregressive signal with unit residual, by its impulse response, [n]."""
    response = lfilter([1.0], [1.0, *(-x for x in a)], np.eye(1, 4000)[0])
    return np.array([response[: 4000 - k] @ response[k:] for k in range(n)])


def test_what_is_unsaid_is_the_filtered_covariance_of_what_is_missing() -> None:
    a, n, impulse = (1.2, -0.6), 81, np.hanning(17)[1:-1]
    there = np.ones(n, dtype=bool)
    there[38:44] = False
    covariance = toeplitz(autocovariance(a, n))
    missing, known = np.flatnonzero(~there), np.flatnonzero(there)
    cross = covariance[np.ix_(missing, known)]
    left = covariance[np.ix_(missing, missing)] - cross @ np.linalg.solve(covariance[np.ix_(known, known)], cross.T)
    filters = np.array([[impulse[7 + t - m] if abs(t - m) <= 7 else 0.0 for m in missing] for t in range(n)])
    power = impulse @ toeplitz(autocovariance(a, impulse.size)) @ impulse
    expected = np.einsum("tm,mk,tk->t", filters, left, filters) / power
    np.testing.assert_allclose(unsaid(model_of(*a), there, impulse)[there], expected[there], rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize(("apart", "most"), [(6, 0.06), (15, 0.02)])
def test_what_two_near_gaps_lack_is_at_most_as_much_too_little_as_is_said(apart: int, most: float) -> None:
    model = fit([(0, rhythm(20_000, 1))], RATE)
    assert model is not None
    impulse = bands._impulse_response(RATE, 13.0, 35.0)
    half = impulse.size // 2
    there = np.ones(4 * half + 60 + apart, dtype=bool)
    there[2 * half : 2 * half + 30] = there[2 * half + 30 + apart : 2 * half + 60 + apart] = False
    missing, between = np.flatnonzero(~there), np.arange(2 * half + 30, 2 * half + 30 + apart)
    distance = np.abs(missing[:, None] - missing)
    b = np.where(distance < model.b.size, model.b[np.minimum(distance, model.b.size - 1)], 0.0)
    filters = impulse[half + between[:, None] - missing]
    exact = np.einsum("tm,mk,tk->t", filters, model.residual * np.linalg.inv(b), filters) / prediction._power(model, impulse)
    lacking = unsaid(model, there, impulse)[between] - exact
    assert -most < lacking.min() < lacking.max() < 0.01


def test_of_white_noise_nothing_is_known_of_a_gap() -> None:
    there = np.ones(4000, dtype=bool)
    there[2000:2030] = False
    impulse = bands._impulse_response(RATE, 13.0, 35.0)
    flat = np.convolve((~there).astype(float), impulse**2 / np.sum(impulse**2), mode="same")
    np.testing.assert_allclose(unsaid(model_of(0.0), there, impulse)[there], flat[there], atol=2e-3)


def test_a_signal_with_few_samples_or_none_that_vary_has_no_model() -> None:
    assert fit([(0, np.zeros(2000))], RATE) is None
    assert fit([(0, np.arange(400.0))], RATE) is None, "fewer than 40 samples per coefficient"


def test_prediction_leaves_at_least_7_percent_less_error_than_straight_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = {"predicted": [], "lines": []}
    for seed in range(6):
        x = rhythm(10_000, seed)
        whole = band_rows([(0.0, RATE, x)], 20, 2.0, 13.0, 35.0).rms
        rng = np.random.default_rng(100 + seed)
        cuts = np.sort(rng.choice(np.arange(60, 9_900), 60, replace=False))
        cuts = cuts[np.concatenate(([True], np.diff(cuts) > 60))]
        edges = [0, *np.stack([cuts, cuts + 30], axis=1).ravel().tolist(), x.size]
        pieces = [(a / RATE, RATE, x[a:b]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        errors["predicted"].append(band_rows(pieces, 20, 2.0, 13.0, 35.0).rms / whole - 1)
        with monkeypatch.context() as patch:
            patch.setattr(bands, "fit", lambda *_: None)
            errors["lines"].append(band_rows(pieces, 20, 2.0, 13.0, 35.0).rms / whole - 1)
    spread = {name: float(np.std(found)) for name, found in errors.items()}
    assert spread["predicted"] < 0.93 * spread["lines"], spread
    assert abs(float(np.mean(errors["predicted"]))) < 0.02
