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


@pytest.mark.parametrize("scale", [2.0**-500, 2.0**500, 2.0**1000], ids=["tiny", "huge", "near the largest number"])
def test_intervals_have_no_unit_however_large_the_values(scale):
    values = np.random.default_rng(2).exponential(size=40)

    def means(unit, method):
        return session_bootstrap(lambda i: float((values[i] * unit).mean()), 40, draws=500, method=method)

    for method in ("bca", "percentile"):
        plain, scaled = means(1.0, method), means(scale, method)
        assert scaled.method == method
        assert (scaled.low, scaled.high) == (plain.low * scale, plain.high * scale)
        assert scaled.standard_error == pytest.approx(plain.standard_error * scale, rel=1e-12)


def test_a_correction_that_reverses_gives_the_percentile_interval_and_says_so():
    draws = np.linspace(0.0, 1.0, 10**5)
    # every draw is below the estimate, and one session of 500 carries all of it: bias 4.4, acceleration 0.17
    one_of_many = np.append(np.ones(499), 0.0)
    assert bca_interval(draws, 2.0, one_of_many, 0.8).method == "bca"
    reversed_at = bca_interval(draws, 2.0, one_of_many, 0.999)
    assert reversed_at == percentile_interval(draws, 0.999)
    assert reversed_at.method == "percentile"


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_values_that_are_not_finite_have_no_interval(bad):
    draws = np.arange(5.0)
    for call in (
        lambda: percentile_interval(np.append(draws, bad), 0.9),
        lambda: bca_interval(np.append(draws, bad), 0.0, draws, 0.9),
        lambda: bca_interval(draws, bad, draws, 0.9),
        lambda: bca_interval(draws, 0.0, np.append(draws, bad), 0.9),
    ):
        with pytest.raises(ValueError, match="finite"):
            call()


def test_levels_outside_zero_and_one_and_empty_data_are_refused():
    with pytest.raises(ValueError, match="between 0 and 1"):
        percentile_interval(np.zeros(3), 1.0)
    with pytest.raises(ValueError, match="at least one session"):
        resamples(0, 10, 0)
    with pytest.raises(ValueError, match="at least 3 sessions"):
        session_bootstrap(lambda i: float(i.mean()), 2, method="bca", draws=10)
