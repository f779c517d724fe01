"""Mixed models of visits: balanced closed forms, recovery of what was simulated, and typed answers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import check_grad
from scipy.special import expit

from ml.statistics.within_visits.contrasts import Measurements, Reason, Unavailable, average, visit_contrasts
from ml.statistics.within_visits.generalised import binomial, cumulative, fit
from ml.statistics.within_visits.mixed_models import linear_comparison, minutes_comparison, ordinal_comparison


def layout(visits, each):
    return np.repeat(np.arange(visits), 2 * each), np.tile([False, True], visits * each)


def latent(visits=10, each=6, effect=0.8, slope=0.0, seed=0):
    rng = np.random.default_rng(seed)
    visit, arms = layout(visits, each)
    slopes = effect + slope * rng.standard_normal(visits)
    return 0.7 * rng.standard_normal(visits)[visit] + slopes[visit] * arms, visit, arms, rng


def test_balanced_visits_that_differ_give_the_average_over_visits():
    eta, visit, arms, rng = latent(slope=1.5, seed=1)
    data = Measurements.of(eta + 0.5 * rng.standard_normal(visit.size), visit, arms)
    plain, found = average(visit_contrasts(data)), linear_comparison(data)
    assert found.effect.estimate == pytest.approx(plain.estimate, abs=1e-6)
    assert found.effect.standard_error == pytest.approx(plain.standard_error, rel=0.05)
    assert found.effect.degrees == plain.degrees == 9
    contrasts = visit_contrasts(data).contrast
    assert found.slope_sd**2 == pytest.approx(contrasts.var(ddof=1) - found.session_sd**2 / 3, rel=0.15)


def test_without_differences_between_visits_the_error_is_that_of_sessions():
    eta, visit, arms, rng = latent(visits=6, seed=3)
    noise = rng.standard_normal((12, 6))
    noise -= noise.mean(1, keepdims=True)  # the contrasts of all visits are then the same
    rows = np.argsort(2 * visit + arms, kind="stable")
    value = eta.copy()
    value[rows] += noise.ravel()
    found = linear_comparison(Measurements.of(value, visit, arms))
    assert found.slope_sd < 0.05
    assert found.effect.standard_error == pytest.approx(found.session_sd * np.sqrt(2 / 36), rel=0.02)


def test_policies_within_the_controller_are_told_apart_and_shrunk():
    eta, visit, arms, rng = latent(visits=8, each=6, seed=2)
    policy = np.where(arms, np.tile(np.repeat([1, 2, 3], 2), visit.size // 6), 0)
    own = np.array([0.0, -1.0, 0.0, 1.0])[policy]
    found = linear_comparison(Measurements.of(eta + own + 0.5 * rng.standard_normal(visit.size), visit, arms), policy)
    effects = {p.policy: p.estimate for p in found.policies}
    assert list(effects) == [1, 2, 3]
    assert effects[1] < -0.5 < 0.5 < effects[3] < 1.6
    assert found.policy_sd > 0.3
    assert linear_comparison(Measurements.of(eta + own, visit, arms), np.ones(visit.size, dtype=int)).policies == ()


def test_the_likelihoods_have_the_gradients_that_differences_give():
    rng = np.random.default_rng(0)
    design = rng.standard_normal((30, 3))
    category = np.concatenate([np.arange(4), rng.integers(0, 4, 26)])
    for likelihood, start in (
        (binomial(rng.integers(0, 6, 30).astype(float), np.full(30, 5.0), design), rng.standard_normal(3)),
        (cumulative(category, design), np.r_[-1.0, 0.2, 1.1, rng.standard_normal(3)]),
    ):
        assert check_grad(lambda p, f=likelihood: f(p)[0], lambda p, f=likelihood: f(p)[1], start) < 1e-4
        step = 1e-5 * np.eye(start.size)
        numeric = np.array([(likelihood(start - s)[1] - likelihood(start + s)[1]) / 2e-5 for s in step])
        assert likelihood(start)[2] == pytest.approx(numeric, abs=1e-4)


def test_two_categories_are_a_logistic_regression():
    rng = np.random.default_rng(1)
    x = rng.standard_normal((80, 1))
    y = (rng.random(80) < expit(0.5 + x[:, 0])).astype(np.int64)
    ordered = fit(cumulative(y, x), np.zeros(2), {0: 100.0, 1: 100.0}, {})
    counted = fit(binomial(y.astype(float), np.ones(80), np.c_[np.ones(80), x]), np.zeros(2), {0: 100.0, 1: 100.0}, {})
    assert ordered.parameters == pytest.approx([-counted.parameters[0], counted.parameters[1]], abs=1e-5)


def test_the_rating_model_finds_the_log_odds_that_made_the_ratings():
    eta, visit, arms, rng = latent(visits=30, each=8, effect=1.0, seed=4)
    rating = 5 + np.digitize(eta + rng.logistic(size=visit.size), [-1.5, -0.5, 0.5, 1.5])
    found = ordinal_comparison(Measurements.of(rating, visit, arms, resolution=1))
    assert found.effect.estimate == pytest.approx(1.0, abs=0.35)
    assert found.effect.low < 1.0 < found.effect.high
    assert found.visit_sd == pytest.approx(0.7, abs=0.45)


def test_the_tremor_model_finds_the_log_odds_and_that_minutes_of_a_session_go_together():
    eta, visit, arms, rng = latent(visits=30, each=5, effect=-1.0, seed=5)
    minutes = rng.integers(5, 20, visit.size).astype(float)
    count = rng.binomial(minutes.astype(int), expit(-0.5 + eta + rng.standard_normal(visit.size)))
    found = minutes_comparison(Measurements.of(count, visit, arms), minutes)
    assert found.effect.estimate == pytest.approx(-1.0, abs=0.35)
    assert found.session_sd == pytest.approx(1.0, abs=0.45)
    without = np.where(np.arange(visit.size) == 0, 0.0, minutes)
    assert minutes_comparison(Measurements.of(count, visit, arms), without).effect.n_cdbs == found.effect.n_cdbs - 1


def test_an_arm_wholly_above_the_other_keeps_a_finite_effect():
    visit, arms = layout(4, 3)
    found = ordinal_comparison(Measurements.of(np.where(arms, 9, 6) + (np.arange(24) % 3 == 0), visit, arms))
    assert 0 < found.effect.estimate < 30
    assert np.isfinite(found.effect.high)


@pytest.mark.parametrize("model", [linear_comparison, ordinal_comparison, lambda d: minutes_comparison(d, np.full(d.value.size, 5.0))])
def test_nothing_to_fit_is_a_typed_reason(model):
    visit, arms = layout(3, 2)
    assert model(Measurements.of(np.zeros(12), visit, arms)) == Unavailable(Reason.ALL_EQUAL)
    assert model(Measurements.of(np.full(12, np.nan), visit, arms)).reason is Reason.NO_SESSION
    assert model(Measurements.of(np.arange(12) % 4, np.zeros(12), arms)).reason is Reason.TOO_FEW_VISITS
    assert model(Measurements.of([1, 2, 1, 2], [1, 1, 2, 2], [0, 0, 1, 1])).reason is Reason.NO_VISIT_WITH_BOTH_ARMS


def test_more_minutes_with_tremor_than_minutes_are_refused():
    visit, arms = layout(3, 2)
    with pytest.raises(ValueError, match="between 0 and its total"):
        minutes_comparison(Measurements.of(np.arange(12), visit, arms), np.full(12, 5.0))
