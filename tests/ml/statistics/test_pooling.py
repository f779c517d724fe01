"""The random-effects summary against its defining equations and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest, t

from ml.statistics.pooling import paule_mandel, pool, pool_estimates, sign_test
from ml.statistics.within_visits.averages import primary
from ml.statistics.within_visits.contrasts import Measurements, Reason, Unavailable


def test_equal_errors_give_the_t_interval_of_the_estimates():
    y, error = np.array([0.1, 0.9, 0.4, 1.4]), np.full(4, 0.1)
    found = pool_estimates(y, error)
    half = t.ppf(0.975, 3) * y.std(ddof=1) / 2
    assert (found.estimate, found.low, found.high) == pytest.approx((y.mean(), y.mean() - half, y.mean() + half))
    assert found.between_sd == pytest.approx(np.sqrt(y.var(ddof=1) - 0.01))


def test_the_variance_between_solves_the_equation_of_paule_and_mandel():
    y, error = np.array([0.1, 0.9, 0.4, 1.4, -0.3]), np.array([0.1, 0.3, 0.2, 0.4, 0.25])
    tau2 = paule_mandel(y, error)
    w = 1 / (tau2 + error**2)
    assert tau2 > 0
    assert np.sum(w * (y - w @ y / w.sum()) ** 2) == pytest.approx(4)


def test_estimates_that_agree_are_no_narrower_than_their_errors_allow():
    y, error = np.array([0.50, 0.51, 0.49, 0.50]), np.full(4, 0.2)
    found = pool_estimates(y, error)
    assert found.between_sd == found.heterogeneity == 0.0
    assert found.high - found.low == pytest.approx(2 * t.ppf(0.975, 3) * 0.2 / 2)


def test_four_participants_claim_nothing_about_a_population():
    found = pool_estimates(np.array([1.0, 1.1, 0.9, 1.0]), np.full(4, 0.01))
    assert (found.smallest_sign_p, found.sign_p, found.population_claim) == (0.125, 0.125, False)
    assert pool_estimates(np.arange(1.0, 7.0), np.ones(6)).population_claim


@pytest.mark.parametrize(("above", "below"), [(4, 0), (3, 1), (5, 2), (2, 2)])
def test_the_sign_test_is_the_binomial_one(above, below):
    values = np.r_[np.ones(above), -np.ones(below), 0.0]
    assert sign_test(values) == pytest.approx(binomtest(above, above + below).pvalue)
    assert sign_test(np.zeros(3)) == 1.0


def test_the_summary_covers_the_average_of_four_participants():
    rng = np.random.default_rng(0)
    hits = []
    for _ in range(800):
        error = rng.uniform(0.1, 0.5, 4)
        found = pool_estimates(1.0 + 0.3 * rng.standard_normal(4) + error * rng.standard_normal(4), error)
        hits.append(found.low <= 1.0 <= found.high)
    assert np.mean(hits) >= 0.93


def test_participants_without_a_result_are_left_out_and_one_is_too_few():
    visit, arms = np.repeat([1, 2, 3], 4), np.tile([False, True], 6)
    rng = np.random.default_rng(3)
    results = [primary(Measurements.of(rng.normal(size=12), visit, arms)) for _ in range(2)]
    nothing = primary(Measurements.of([], [], []))
    assert pool([*results, nothing]).participants == 2
    assert pool([*results, nothing]).predicted_low is None
    assert pool([results[0], nothing]) == Unavailable(Reason.TOO_FEW_PARTICIPANTS, 1, 2)
    with pytest.raises(ValueError, match="standard error above 0"):
        pool_estimates(np.zeros(2), np.zeros(2))
