"""Actual returns have the horizon, the discount and the scale of the estimates."""

from __future__ import annotations

import numpy as np
import pytest

from app.evaluation.ranking.assessment import actual, mean_of
from ml.mdp import MdpSettings
from ml.qoc import Qoc
from ml.trajectories import SessionTrajectory

SETTINGS = MdpSettings(xi_beta=1.0, gamma=0.9, c1=0.5, c2=10, c3=0, c4=0)


def session(beta: list[float], amplitude: list[float], grasp: float | None = 2.0) -> SessionTrajectory:
    return SessionTrajectory(1, 1, "rl", np.ones(10), np.array(beta), np.array(amplitude), Qoc(grasp_hz=grasp))


def test_the_return_is_the_discounted_sum_over_the_horizon_and_r_end() -> None:
    found = actual(session([0.5, 2.0, 0.5, 9.0], [1.0, 1.0, 0.0, 0.0]), SETTINGS, 3)
    assert found.step_return == pytest.approx(-0.5 + 0.9 * -1.5 + 0.81 * 0.0)
    assert found.end_reward == pytest.approx(20.0)
    assert found.value == pytest.approx(found.step_return + 20.0)
    assert found.energy == pytest.approx(0.5)


def test_an_unknown_step_counts_as_the_mean_of_the_known_ones() -> None:
    beta = [2.0] * 10
    beta[4] = np.nan
    found = actual(session(beta, [0.0] * 10), SETTINGS, 10)
    assert found.step_return == pytest.approx(-sum(0.9**t for t in range(10)))


def test_a_session_of_which_too_little_is_known_has_no_return() -> None:
    short = actual(session([2.0] * 3, [0.0] * 3), SETTINGS, 100)
    assert short.step_return is None
    assert short.value is None
    # 20 of 100 steps hold 88 % of the weight at a discount of 0.9
    assert actual(session([2.0] * 20, [0.0] * 20), SETTINGS, 100).step_return == pytest.approx(-10.0, rel=1e-3)


def test_a_missing_qoc_masks_r_end_and_not_the_steps() -> None:
    found = actual(session([2.0] * 4, [0.0] * 4, grasp=None), SETTINGS, 4)
    assert found.step_return is not None
    assert found.end_reward is None
    assert found.value is None


def test_means_leave_out_what_is_unknown() -> None:
    assert mean_of([1.0, None, 3.0]) == 2.0
    assert mean_of([None]) is None
