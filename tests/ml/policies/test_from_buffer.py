from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ml.policies.from_buffer import CONSTANT_GRID, behaviour_mean, best_constant, proportional_from_buffer
from ml.trajectories import ReplayBuffer


def test_the_behaviour_mean_is_the_mean_of_the_logged_fractions(buffer):
    logged = np.concatenate([s.amplitude for s in buffer.sessions])
    assert behaviour_mean(buffer).act(np.zeros((2, 10))) == pytest.approx([logged.mean()] * 2)


def test_proportional_control_runs_from_floor_to_full_between_the_quantiles_of_beta(buffer):
    beta = np.sort(np.concatenate([s.padded_beta for s in buffer.sessions]))
    policy = proportional_from_buffer(buffer, 0.25, 0.75, floor=0.2)
    low, middle, high = (
        np.full((1, 10), q) for q in (np.quantile(beta, 0.25), np.quantile(beta, [0.25, 0.75]).mean(), np.quantile(beta, 0.75))
    )
    assert policy.act(low)[0] == pytest.approx(0.2)
    assert policy.act(middle)[0] == pytest.approx(0.6)
    assert policy.act(high)[0] == pytest.approx(1.0)


def test_beta_without_spread_or_quantiles_out_of_order_are_refused(buffer):
    flat = [dataclasses.replace(s, lead_beta=np.full(10, 5.0), beta=np.full(s.steps, 5.0)) for s in buffer.sessions]
    with pytest.raises(ValueError, match="no spread"):
        proportional_from_buffer(ReplayBuffer(buffer.settings, tuple(flat), "uV", "table"))
    with pytest.raises(ValueError, match="must rise"):
        proportional_from_buffer(buffer, 0.9, 0.1)


def test_the_best_constant_is_the_one_of_the_largest_estimate_and_of_equals_the_smallest():
    def estimate(policy):
        return -round(abs(policy.act(np.zeros((1, 10)))[0] - 0.62), 1)

    choice = best_constant(estimate)
    assert choice.policy.amplitude == 0.6
    assert tuple(choice.estimates) == CONSTANT_GRID
    assert choice.estimates[1.0] == pytest.approx(-0.4)


def test_a_choice_without_amplitudes_or_with_an_estimate_that_is_no_number_is_refused():
    with pytest.raises(ValueError, match="one or more"):
        best_constant(lambda policy: 0.0, ())
    with pytest.raises(ValueError, match=r"0\.4 is not finite"):
        best_constant(lambda policy: float("nan"), (0.4,))
