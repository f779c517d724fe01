"""Actual returns against closed forms, the one rule for gaps, and gains in which what two policies share cancels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from ml.mdp import MdpSettings
from ml.qoc import Qoc
from ml.returns import KNOWN_SHARE, Gain, actual_return, gain, step_return, step_returns
from ml.trajectories import SessionTrajectory

SETTINGS = MdpSettings(xi_beta=1.0, gamma=0.9, c1=0.5, c2=10, c3=0, c4=0)


def test_a_whole_session_returns_its_discounted_sum_and_r_end() -> None:
    beta, amplitude = np.array([0.5, 2.0, 0.5, 9.0]), np.array([1.0, 1.0, 0.0, 0.0])
    session = SessionTrajectory(1, 1, "rl", np.ones(10), beta, amplitude, Qoc(grasp_hz=2.0))
    found = actual_return(session, SETTINGS, 3)
    assert found.step_return == pytest.approx(-0.5 + 0.9 * -1.5)
    assert (found.end_reward, found.value) == (20.0, pytest.approx(20.0 - 0.5 - 1.35))
    assert actual_return(SessionTrajectory(1, 1, "rl", np.ones(10), beta, amplitude), SETTINGS, 3).value is None


def test_constant_rewards_return_the_geometric_sum_whatever_is_missing() -> None:
    whole = -2.0 * (1 - 0.99**300) / (1 - 0.99)
    rewards = np.full(300, -2.0)
    assert step_return(rewards, 0.99, 300) == pytest.approx(whole)
    rewards[[3, 50, 51, 200]] = np.nan
    assert step_return(rewards, 0.99, 300) == pytest.approx(whole)
    assert step_return(rewards[:250], 0.99, 300) == pytest.approx(whole)


def test_a_missing_step_counts_as_the_weighted_mean_of_the_known_ones_and_not_as_the_best_there_is() -> None:
    rewards = np.array([-1.0, np.nan, -3.0, -2.0])
    weight = np.array([1.0, 0.5, 0.25, 0.125])
    mean = (-1.0 - 0.75 - 0.25) / 1.375
    assert KNOWN_SHARE * weight.sum() < 1.375
    assert step_return(rewards, 0.5, 4) == pytest.approx(mean * weight.sum())
    assert step_return(rewards, 0.5, 4) < np.nansum(rewards * weight)


@pytest.mark.parametrize(("known", "speaks"), [(69, False), (70, True)])
def test_a_session_speaks_from_the_least_share_of_the_weight_on(known: int, speaks: bool) -> None:
    rewards = np.full(100, -1.0)
    rewards[known:] = np.nan
    assert (step_return(rewards, 1.0 - 1e-15, 100) is not None) == speaks


def test_several_sessions_are_summed_as_each_alone() -> None:
    rng = np.random.default_rng(0)
    rewards, known = rng.normal(size=(5, 40)), rng.random((5, 40)) < 0.9
    sums, shares = step_returns(rewards, known, 0.97)
    assert sums == pytest.approx([step_return(np.where(k, r, np.nan), 0.97, 40) for r, k in zip(rewards, known, strict=True)])
    assert ((shares > 0) & (shares <= 1)).all()
    assert step_returns(rewards, np.zeros_like(known), 0.97)[1].max() == 0


def test_what_all_policies_share_cancels_in_a_gain() -> None:
    rng = np.random.default_rng(0)
    days = 100 * rng.standard_normal(4000)
    ours, theirs = 7.0 + days + rng.standard_normal(4000), 5.0 + days
    found = gain(ours, theirs)
    assert found.value == pytest.approx(2.0, abs=0.05)
    assert found.standard_error == pytest.approx(1.0, abs=0.05)
    assert found.low == pytest.approx(2.0 - norm.ppf(0.95), abs=0.1)
    assert found.high == pytest.approx(2.0 + norm.ppf(0.95), abs=0.1)
    assert found.level == 0.9
    assert gain(ours, theirs, level=0.5).low == pytest.approx(2.0, abs=0.1)


def test_draws_that_cannot_be_compared_are_refused() -> None:
    draws = np.arange(40.0)
    with pytest.raises(ValueError, match="same resampled sessions"):
        gain(draws, draws[:30])
    with pytest.raises(ValueError, match="20 draws or more"):
        gain(draws[:19], draws[:19])
    with pytest.raises(ValueError, match="not finite"):
        gain(np.where(draws == 3, np.nan, draws), draws)
    with pytest.raises(ValueError, match="between 0 and 1"):
        gain(draws, draws, level=1.0)


def test_a_gain_that_was_stored_without_its_interval_still_opens() -> None:
    assert Gain(**{"value": 1.0, "low": 0.5, "standard_error": 0.2}).high == float("inf")
