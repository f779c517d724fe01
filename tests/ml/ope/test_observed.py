from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.ope.flags import DAYS_UNKNOWN
from ml.ope.observed import day_noise, mean_over_days, observed, session_returns
from ml.qoc import Qoc


def test_the_observed_return_of_a_controller_is_the_mean_over_its_sessions(small_buffer):
    found = observed(small_buffer, 30)[("cdbs", None)]
    sessions = [s for s in small_buffer.sessions if s.controller == "cdbs"]
    discount = small_buffer.settings.gamma ** np.arange(30)
    by_hand = [float(s.rewards(small_buffer.settings)[:30] @ discount) + s.end_reward(small_buffer.settings) for s in sessions]
    assert found.n == 3
    assert found.value == pytest.approx(np.mean(by_hand))
    assert found.standard_error == pytest.approx(np.std(by_hand, ddof=1) / np.sqrt(3))
    assert found.interval.low <= found.value <= found.interval.high


def test_a_single_session_has_no_standard_error_and_no_interval(small_buffer):
    found = observed(small_buffer, 30)[("other", None)]
    assert (found.n, found.standard_error, found.interval) == (1, None, None)


def test_a_session_without_outcomes_counts_for_its_steps(small_buffer):
    sessions = list(small_buffer.sessions)
    k = next(i for i, s in enumerate(sessions) if s.controller == "cdbs")
    sessions[k] = replace(sessions[k], qoc=Qoc())
    found = observed(replace(small_buffer, sessions=tuple(sessions)), 30)[("cdbs", None)]
    steps, ends = session_returns([s for s in sessions if s.controller == "cdbs"], small_buffer.settings, 30)
    assert np.isnan(ends).sum() == 1
    assert found.value == pytest.approx(steps.mean() + np.nanmean(ends))


def shifted_days(small_buffer, shift, seed=0):
    """Build twelve cDBS sessions on four days whose ratings differ by day."""
    rng = np.random.default_rng(seed)
    base = next(s for s in small_buffer.sessions if s.controller == "cdbs")
    days = shift * rng.normal(size=4)
    sessions = [
        replace(base, session_id=i, visit=1 + i // 3, qoc=Qoc(2.0 + days[i // 3] + 0.05 * rng.normal(), 7, 10.0)) for i in range(12)
    ]
    return replace(small_buffer, sessions=tuple(sessions)), days


def test_days_that_differ_widen_what_is_known_of_the_level_by_the_error_of_their_mean(small_buffer):
    buffer, days = shifted_days(small_buffer, 0.5)
    noise, flag = day_noise(buffer, 30, 20_000, 0)
    assert flag is None
    expected = 10.0 * days.std(ddof=1) / 2.0  # C2 times the spread of days over the root of their number
    quartile = 0.7649  # of Student's t with 3 degrees of freedom
    assert np.quantile(noise, 0.75) == pytest.approx(expected * quartile, rel=0.2)


def test_days_that_do_not_differ_add_nothing_and_a_single_day_is_flagged(small_buffer):
    buffer, _ = shifted_days(small_buffer, 0.0, seed=3)
    assert np.abs(day_noise(buffer, 30, 50, 0)[0]).max() < 1.0
    one = replace(buffer, sessions=tuple(replace(s, visit=1) for s in buffer.sessions))
    noise, flag = day_noise(one, 30, 50, 0)
    assert not noise.any()
    assert flag == DAYS_UNKNOWN


def test_the_mean_over_days_weighs_a_crowded_day_less_the_more_days_differ():
    visits = np.array([1] * 10 + [2, 3, 4])
    rng = np.random.default_rng(0)
    apart = mean_over_days((10.0 * visits + 0.01 * rng.standard_normal(13))[None], visits, 50, 0).weights
    alike = mean_over_days(rng.standard_normal((1, 13)), visits, 50, 0).weights
    for weights in (apart, alike):
        assert weights.sum() == pytest.approx(1.0)
        assert np.ptp(weights[:10]) == pytest.approx(0.0, abs=1e-12)
    assert 10 * apart[0] == pytest.approx(0.25, abs=0.01)
    assert 0.35 < 10 * alike[0] < 10 / 13


def test_what_all_policies_share_of_a_day_is_common_and_what_they_do_not_is_their_own():
    rng = np.random.default_rng(1)
    visits = np.repeat(np.arange(5), 4)
    day = 8.0 * rng.standard_normal(5)[visits]
    own = rng.standard_normal((2, 20))
    found = mean_over_days(np.stack([50.0 + day, 60.0 + day]) + own, visits, 4000, 0)
    assert found.unknown is None
    assert 2.0 < found.common.std() < 12.0
    assert found.own.shape == (2, 4000)
    assert found.own.std(axis=1).max() < 1.0


def test_intervals_of_a_mean_over_few_days_cover_it_as_often_as_they_say():
    hits = []
    for seed in range(200):
        rng = np.random.default_rng(100 + seed)
        visits = np.repeat(np.arange(4), 5)
        returns = 6.0 * rng.standard_normal(4)[visits] + 5.0 * rng.standard_normal(20)
        found = mean_over_days(returns[None], visits, 400, seed)
        low, high = np.quantile(returns @ found.weights + found.common, (0.05, 0.95))
        hits.append(low <= 0.0 <= high)
    assert 0.82 <= np.mean(hits) <= 0.97


def test_one_day_tells_nothing_of_days_and_says_so():
    found = mean_over_days(np.arange(6.0)[None], np.ones(6, dtype=int), 30, 0)
    assert found.unknown == DAYS_UNKNOWN
    np.testing.assert_allclose(found.weights, 1 / 6)
