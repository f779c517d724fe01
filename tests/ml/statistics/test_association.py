"""Associations within and between visits, separated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import linregress

from ml.statistics.association import between_visits, within_visits
from ml.statistics.within_visits.contrasts import Reason, Unavailable


def test_days_that_move_both_are_between_visits_and_not_within():
    rng = np.random.default_rng(0)
    visit = np.repeat(np.arange(8), 6)
    day = 3 * rng.standard_normal(8)
    x, y = day[visit] + rng.standard_normal(48), -day[visit] + rng.standard_normal(48)
    within, between = within_visits(x, y, visit), between_visits(x, y, visit)
    assert within.low < 0 < within.high
    assert between.high < 0
    assert between.correlation < -0.9


def test_the_slope_within_visits_is_least_squares_with_a_level_of_each_visit():
    rng = np.random.default_rng(1)
    visit = np.repeat(np.arange(5), [3, 4, 5, 6, 2])
    x = rng.standard_normal(20)
    y = 0.7 * x + visit + rng.standard_normal(20)
    columns = np.c_[x, (visit[:, None] == np.arange(5))]
    assert within_visits(x, y, visit).slope == pytest.approx(np.linalg.lstsq(columns, y, rcond=None)[0][0])


def test_between_visits_it_is_the_regression_of_the_means():
    rng = np.random.default_rng(2)
    visit = np.repeat(np.arange(6), 3)
    x, y = rng.standard_normal((2, 18))
    expected = linregress([x[visit == v].mean() for v in range(6)], [y[visit == v].mean() for v in range(6)])
    found = between_visits(x, y, visit)
    assert (found.slope, found.p_value, found.correlation) == pytest.approx((expected.slope, expected.pvalue, expected.rvalue))


def test_slopes_that_differ_between_visits_do_not_make_the_interval_too_narrow():
    rng = np.random.default_rng(3)
    hits = []
    for _ in range(500):
        visit = np.repeat(np.arange(6), 8)
        x = rng.standard_normal(48)
        y = (1.0 + rng.standard_normal(6))[visit] * x + rng.standard_normal(48)
        found = within_visits(x, y, visit)
        hits.append(found.low <= 1.0 <= found.high)
    assert np.mean(hits) >= 0.93


@pytest.mark.parametrize("function", [within_visits, between_visits])
def test_nothing_to_relate_has_a_typed_reason(function):
    visit = np.repeat(np.arange(5), 3)
    x = np.random.default_rng(4).standard_normal(15)
    assert function(x, np.ones(15), visit).reason is Reason.ALL_EQUAL
    assert function(x, np.full(15, np.nan), visit).reason is Reason.TOO_FEW_VISITS
    assert isinstance(function(x[:3], x[:3], visit[:3]), Unavailable)
    assert isinstance(function(x, x, visit), Unavailable) == (function is within_visits)
    with pytest.raises(ValueError, match="one entry per session"):
        function(x, x[:3], visit)


def test_what_one_visit_carries_and_what_is_alike_at_every_visit_are_told_apart():
    visit, place = np.repeat(np.arange(5), 3), np.tile(np.arange(3.0), 5)
    assert within_visits(np.where(visit == 2, place, 1.0), place, visit).reason is Reason.ONE_VISIT
    assert within_visits(place, 2 * place, visit).reason is Reason.NO_VARIANCE
