"""The metrics of the calibration against hand-computed values and against the one-at-a-time versions of `ml.ope.compare.metrics`."""

from __future__ import annotations

import numpy as np
import pytest

from app.analysis.calibration_accuracy import Pair, accuracies, least_range, mean_interval, rank_correlations
from ml.ope.compare.metrics import spearman


def pair(predicted: float, *returns: float, visit: int = 2, reach: float = 5.0) -> Pair:
    return Pair(visit, predicted, predicted - reach, predicted + reach, returns)


def test_metrics_of_one_visit_are_those_of_the_paper() -> None:
    # actual means 10, 20, 40; estimates 12, 30, 25: the second is taken for the best
    pairs = [pair(12.0, 9.0, 11.0), pair(30.0, 20.0), pair(25.0, 38.0, 40.0, 42.0)]
    overall, visit = accuracies("fqe", pairs)
    assert (overall.visit, visit.visit, visit.policies, visit.sessions) == (None, 2, 3, 6)
    for row in (overall, visit):
        assert row.mae.value == pytest.approx((2 + 10 + 15) / 3)
        assert row.mae_of_range.value == pytest.approx(9 / 30)
        assert row.rank_correlation.value == pytest.approx(0.5)
        assert row.rank_p == pytest.approx(1.0)  # every one of the 6 orders reaches |0.5|
        assert row.regret.value == pytest.approx(20.0)
        assert row.regret_of_range.value == pytest.approx(20 / 30)
        assert row.regret_as_paper.value == pytest.approx(20 / 40)
        assert row.coverage.value == pytest.approx(1 / 3)
        assert row.mae.low is None, "one visit is one day: how far days differ is not known"


def test_over_visits_the_regret_is_the_mean_of_visits_with_a_choice() -> None:
    pairs = [
        pair(1.0, 10.0), pair(2.0, 4.0),  # regret 6 of range 6
        pair(1.0, 3.0, visit=3), pair(2.0, 5.0, visit=3),  # regret 0
        pair(9.0, 1.0, visit=4),  # nothing to choose
    ]  # fmt: skip
    overall, *by_visit = accuracies("fqe", pairs)
    assert [r.regret.value for r in by_visit] == [6.0, 0.0, None]
    assert by_visit[2].regret.missing == "a ranking needs at least 2 policies at the visit; there is 1"
    assert by_visit[2].rank_correlation.value is None
    assert (overall.regret.value, overall.regret_of_range.value) == (3.0, 0.5)
    alone = accuracies("fqe", [pair(9.0, 1.0)])[0]
    assert (alone.mae.value, alone.regret.value, alone.rank_correlation.value) == (8.0, None, None)
    assert "no visit has them" in alone.regret.missing


def test_no_interval_is_given_where_sessions_or_visits_are_too_few() -> None:
    assert mean_interval([1.0, 2.0]) is None
    low, high = mean_interval([1.0, 2.0, 3.0]) or (9.0, 9.0)
    assert 1.0 <= low < 2.0 < high <= 3.0
    many_sessions = [pair(1.0, 10.0, 12.0, 11.0, visit=v) for v in (2, 3)] + [pair(2.0, 4.0, 5.0, visit=v) for v in (2, 3)]
    two = accuracies("fqe", many_sessions)[0]
    assert (two.visit, two.mae.low, two.mae.high, two.regret.low) == (None, None, None, None)
    more = [pair(3.0, 5.0, visit=v) for v in (4, 5, 6)]
    four, five = (accuracies("fqe", [*many_sessions, *more[:n]])[0] for n in (2, 3))
    assert (four.mae.low, four.mae.high) == (None, None), "90 % intervals of so few visits cover three quarters"
    assert five.mae.low is not None


def test_visits_are_resampled_whole_and_not_their_sessions() -> None:
    # the error is 10 at one visit and 0 at four others, whatever the number of sessions: a visit is one draw of five
    pairs = [pair(20.0, *[10.0] * 30, visit=1)] + [pair(10.0, 10.0, visit=v) for v in (2, 3, 4, 5)]
    mae = accuracies("fqe", pairs)[0].mae
    assert (mae.value, mae.low) == (2.0, 0.0)
    assert mae.high is not None
    assert mae.high >= 4.0, "two of five draws are that visit in more than 5 % of the resamples"
    # the same policy at two visits is two facts
    assert accuracies("fqe", pairs)[0].policies == 5


def test_nothing_is_divided_by_a_range_within_the_noise_of_a_session() -> None:
    # off by 29, while both means are 1 apart and sessions of one policy 2: no "2900 %"
    noisy = [pair(109.5, 79.0, 81.0), pair(110.5, 80.0, 82.0)]
    assert least_range(noisy) == pytest.approx(2**0.5)
    for row in accuracies("fqe", noisy):
        assert (row.mae_of_range.value, row.regret_of_range.value) == (None, None)
        assert "closer together than sessions of one policy" in row.mae_of_range.missing
        assert row.mae.value == pytest.approx(29.5)
    # no policy was tested twice: a range of 1 around 80 is none either, and one of 20 is
    assert accuracies("fqe", [pair(109.5, 80.0), pair(110.5, 81.0)])[0].mae_of_range.value is None
    assert accuracies("fqe", [pair(109.5, 80.0), pair(110.5, 100.0)])[0].mae_of_range.value == pytest.approx(1.0)
    # two sessions that agree by chance say nothing of the noise
    assert least_range([pair(109.5, 80.0, 80.0), pair(110.5, 80.1)]) == pytest.approx(0.801)
    assert accuracies("fqe", [pair(109.5, 80.0, 80.0), pair(110.5, 80.1)])[0].mae_of_range.value is None
    # a best return next to 0 is no divisor
    assert accuracies("fqe", [pair(1.0, 0.01), pair(0.0, -20.0)])[0].regret_as_paper.value is None


def test_metrics_of_all_resamples_at_once_are_those_of_one_at_a_time() -> None:
    rng = np.random.default_rng(3)
    for size in (2, 3, 6):
        means, estimated = np.round(rng.normal(size=(40, size)), 1), np.round(rng.normal(size=size), 1)
        means[rng.random(means.shape) < 0.2] = np.nan
        for row, rho in zip(means, rank_correlations(means, estimated), strict=True):
            there = np.isfinite(row)
            if there.sum() < 2:
                assert np.isnan(rho)
                continue
            expected = spearman(row[there], estimated[there])
            assert (np.isnan(rho) and expected is None) or rho == pytest.approx(expected)
