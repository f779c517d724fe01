"""The mixed model against closed forms: marginal likelihood, one-way analysis of variance, ordinary and ridge regression."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from ml.statistics.mixed import MixedModel, Sums


def one_way(rng, days=40, each=5, between=2.0, within=1.0):
    level = between * rng.standard_normal(days)
    day = np.repeat(np.arange(days), each)
    y = 3.0 + level[day] + within * rng.standard_normal(days * each)
    design = np.concatenate([np.ones((y.size, 1)), (day[:, None] == np.arange(days)).astype(float)], axis=1)
    return design, y, day


def test_without_groups_it_is_ordinary_least_squares():
    rng = np.random.default_rng(0)
    x = np.c_[np.ones(30), rng.normal(size=(30, 2))]
    y = x @ [1.0, -2.0, 0.5] + rng.normal(size=30)
    fit = MixedModel(3, {}, {}).fit(Sums.of(x, y))
    expected, residual, *_ = np.linalg.lstsq(x, y, rcond=None)
    np.testing.assert_allclose(fit.coefficients, expected, rtol=1e-6)
    np.testing.assert_allclose(fit.covariance, np.linalg.inv(x.T @ x) * residual[0] / 25, rtol=1e-6)


def test_a_known_ratio_is_a_ridge_penalty():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(20, 3)), rng.normal(size=20)
    fit = MixedModel(3, {}, {0: 0.5, 1: 0.5, 2: 0.5}).fit(Sums.of(x, y))
    np.testing.assert_allclose(fit.coefficients, np.linalg.solve(x.T @ x + 2 * np.eye(3), x.T @ y), rtol=1e-6)


def test_the_posterior_of_a_variance_is_the_likelihood_of_error_contrasts_times_the_half_cauchy():
    # log |V| + log |X^T V^-1 X| + (n - p) log S^2 against the density of contrasts A y that do not see the mean.
    rng = np.random.default_rng(2)
    design, y, _ = one_way(rng, days=5, each=3)
    model = MixedModel(6, {"day": range(1, 6)}, {})
    fit = model.fit(Sums.of(design, y))
    contrasts = np.linalg.svd(np.ones((1, y.size)))[2][1:]
    found = []
    for ratio, square in zip(fit.ratios[:, 0], fit.squares, strict=True):
        v = contrasts @ (np.eye(y.size) + ratio * design[:, 1:] @ design[:, 1:].T) @ contrasts.T
        sigma2 = square / (y.size - 1)
        prior = np.sqrt(ratio) / (1 + ratio)
        found.append(multivariate_normal(np.zeros(y.size - 1), sigma2 * v).logpdf(contrasts @ y) + np.log(prior))
    weights = np.exp(np.array(found) - max(found))
    np.testing.assert_allclose(fit.weights, weights / weights.sum(), rtol=1e-6)


def test_balanced_days_are_shrunk_as_the_analysis_of_variance_says():
    rng = np.random.default_rng(3)
    design, y, day = one_way(rng, days=80, each=4, between=1.5)
    fit = MixedModel(81, {"day": range(1, 81)}, {}).fit(Sums.of(design, y))
    means = np.array([y[day == d].mean() for d in range(80)])
    within = np.mean([y[day == d].var(ddof=1) for d in range(80)])
    between = means.var(ddof=1) - within / 4
    assert fit.share("day") == pytest.approx(between / (between + within), abs=0.05)
    assert fit.coefficients[0] == pytest.approx(y.mean(), abs=1e-6)
    slope = np.polyfit(means - y.mean(), fit.coefficients[1:], 1)[0]
    assert slope == pytest.approx(between / (between + within / 4), abs=0.03)
    assert np.sqrt(fit.covariance[0, 0]) == pytest.approx(np.sqrt((between + within / 4) / 80), rel=0.15)


def test_draws_have_the_posterior_mean_and_covariance():
    rng = np.random.default_rng(4)
    design, y, _ = one_way(rng, days=8, each=4)
    fit = MixedModel(9, {"day": range(1, 9)}, {}).fit(Sums.of(design, y))
    draws = fit.draws(40_000, np.random.default_rng(5))
    np.testing.assert_allclose(draws.mean(0), fit.coefficients, atol=0.05)
    np.testing.assert_allclose(np.cov(draws.T), fit.covariance, atol=0.1 * fit.covariance.max())


def test_intervals_of_a_slope_under_few_days_cover_it_as_often_as_they_say():
    hits = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        day = np.repeat(np.arange(4), 5)
        x = rng.normal(size=20)
        y = 1.0 + 2.0 * x + 1.5 * rng.standard_normal(4)[day] + rng.standard_normal(20)
        design = np.c_[np.ones(20), x, (day[:, None] == np.arange(4)).astype(float)]
        fit = MixedModel(6, {"day": range(2, 6)}, {1: 100.0}).fit(Sums.of(design, y))
        low, high = np.quantile(fit.draws(400, rng)[:, 1], (0.05, 0.95))
        hits.append(low <= 2.0 <= high)
    assert 0.85 <= np.mean(hits) <= 0.95


def test_intervals_of_the_level_under_few_days_are_those_of_few_days():
    hits = []
    for seed in range(300):
        rng = np.random.default_rng(1000 + seed)
        design, y, _ = one_way(rng, days=5, each=4, between=1.5)
        fit = MixedModel(6, {"day": range(1, 6)}, {}).fit(Sums.of(design, y))
        low, high = np.quantile(fit.draws(400, rng)[:, 0], (0.05, 0.95))
        hits.append(low <= 3.0 <= high)
    assert 0.84 <= np.mean(hits) <= 0.96


def test_a_column_of_zeros_changes_nothing():
    rng = np.random.default_rng(6)
    x, y = np.c_[np.ones(12), rng.normal(size=12)], rng.normal(size=12)
    bare = MixedModel(2, {"slope": [1]}, {}).fit(Sums.of(x, y))
    wide = MixedModel(3, {"slope": [1, 2]}, {}).fit(Sums.of(np.c_[x, np.zeros(12)], y))
    np.testing.assert_allclose(wide.coefficients, [*bare.coefficients, 0.0], atol=1e-12)


def test_no_rows_are_an_error():
    with pytest.raises(ValueError, match="at least one row"):
        MixedModel(1, {}, {}).fit(Sums(np.zeros((1, 1)), np.zeros(1), 0.0, 0))
