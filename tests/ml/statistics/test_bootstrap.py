from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import bootstrap as scipy_bootstrap

from ml.statistics.bootstrap import bca_interval, percentile_interval, resamples, session_bootstrap


def test_the_same_seed_resamples_the_same_sessions():
    np.testing.assert_array_equal(resamples(7, 20, 3), resamples(7, 20, 3))
    assert not np.array_equal(resamples(7, 20, 3), resamples(7, 20, 4))


def test_the_standard_error_of_a_mean_is_sd_over_root_n():
    values = np.random.default_rng(0).normal(size=50)
    interval = session_bootstrap(lambda i: float(values[i].mean()), 50, draws=4000)
    assert interval.standard_error == pytest.approx(values.std() / np.sqrt(50), rel=0.05)


def test_sessions_stay_whole_so_steps_of_one_session_do_not_count_as_independent():
    rng = np.random.default_rng(1)
    session_means = rng.normal(size=12)
    sessions = [m + 0.01 * rng.normal(size=300) for m in session_means]
    interval = session_bootstrap(lambda i: float(np.concatenate([sessions[k] for k in i]).mean()), 12, draws=800)
    naive = np.concatenate(sessions).std() / np.sqrt(12 * 300)
    assert interval.standard_error > 10 * naive


def test_a_bca_interval_of_a_skewed_mean_is_scipys():
    values = np.random.default_rng(2).exponential(size=40)
    ours = session_bootstrap(lambda i: float(values[i].mean()), 40, level=0.9, draws=6000, method="bca")
    theirs = scipy_bootstrap(
        (values,), np.mean, n_resamples=6000, confidence_level=0.9, method="BCa", rng=np.random.default_rng(3)
    ).confidence_interval
    assert ours.low == pytest.approx(theirs.low, abs=0.02)
    assert ours.high == pytest.approx(theirs.high, abs=0.02)


def test_without_bias_and_skew_bca_is_the_percentile_interval():
    draws = np.linspace(-1, 1, 2001)
    bca = bca_interval(draws, 0.0, np.array([-1.0, 0.0, 1.0]), 0.9)
    percentile = percentile_interval(draws, 0.9)
    assert (bca.low, bca.high) == pytest.approx((percentile.low, percentile.high), abs=2e-3)


def test_levels_outside_zero_and_one_and_empty_data_are_refused():
    with pytest.raises(ValueError, match="between 0 and 1"):
        percentile_interval(np.zeros(3), 1.0)
    with pytest.raises(ValueError, match="at least one session"):
        resamples(0, 10, 0)
    with pytest.raises(ValueError, match="at least 3 sessions"):
        session_bootstrap(lambda i: float(i.mean()), 2, method="bca", draws=10)
