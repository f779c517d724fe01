"""Weighted doubly robust estimates against the textbook's loops and against exact values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.ope.compare.metrics import accuracy
from ml.ope.doubly_robust import DoublyRobust, step_weights, weighted_doubly_robust
from ml.ope.fqe.estimator import Fqe, FqeConfig
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer

GO = np.array([[[0.9, 0.1], [0.4, 0.6]], [[0.5, 0.5], [0.2, 0.8]]])
REWARD = np.array([[1.0, -0.5], [0.2, 2.0]])
TARGET = np.array([[0.8, 0.2], [0.3, 0.7]])
STEPS, GAMMA = 6, 0.9


def exact_tables():
    """Compute Q and V of the target with each number of steps to go, [STEPS + 1, 2, 2] and [STEPS + 1, 2]."""
    q, v = np.zeros((STEPS + 1, 2, 2)), np.zeros((STEPS + 1, 2))
    for left in range(1, STEPS + 1):
        q[left] = REWARD + GAMMA * GO @ v[left - 1]
        v[left] = (TARGET * q[left]).sum(1)
    return q, v


def logged(n, seed):
    """Simulate states [n, STEPS + 1], actions and log ratios [n, STEPS] of a uniform behaviour from state 0."""
    rng = np.random.default_rng(seed)
    s, a = np.zeros((n, STEPS + 1), dtype=int), rng.integers(0, 2, (n, STEPS))
    for t in range(STEPS):
        s[:, t + 1] = rng.random(n) < GO[s[:, t], a[:, t], 1]
    return s, a, np.log(TARGET[s[:, :-1], a] / 0.5)


def temporal_errors(s, a, q, v):
    left = np.arange(STEPS, 0, -1)
    return REWARD[s[:, :-1], a] + GAMMA * v[left - 1, s[:, 1:]] - q[left, s[:, :-1], a]


def textbook(s, a, log_ratio, q, v):
    """Compute eq. 9 of Thomas and Brunskill 2016 by loops: sum of w_t r_t - (w_t Q_t - w_{t-1} V_t)."""
    n, total = len(s), 0.0
    for t in range(STEPS):
        now = np.exp(log_ratio[:, : t + 1].sum(1))
        before = np.exp(log_ratio[:, :t].sum(1))
        for i in range(n):
            w, w_before = now[i] / now.sum(), before[i] / before.sum()
            left = STEPS - t
            total += GAMMA**t * (w * REWARD[s[i, t], a[i, t]] - (w * q[left, s[i, t], a[i, t]] - w_before * v[left, s[i, t]]))
    return total


def test_the_telescoped_sum_is_the_textbooks_formula_with_any_value_function():
    s, a, log_ratio = logged(15, 0)
    rng = np.random.default_rng(1)
    q, v = rng.normal(size=(STEPS + 1, 2, 2)), rng.normal(size=(STEPS + 1, 2))
    v[0] = 0.0
    fast = weighted_doubly_robust(
        v[STEPS, s[:, 0]], step_weights(log_ratio, np.ones_like(log_ratio, dtype=bool)), temporal_errors(s, a, q, v), GAMMA
    )
    assert fast == pytest.approx(textbook(s, a, log_ratio, q, v))


@pytest.mark.parametrize("error", [0.0, 3.0])
def test_a_right_or_wrong_value_function_both_lead_to_the_exact_value(error):
    s, a, log_ratio = logged(100_000, 2)
    q, v = exact_tables()
    q[1:, :, 1] += error  # wrong about one action
    v[1:] += TARGET[:, 1] * error
    exact = exact_tables()[1][STEPS, 0]
    weights = step_weights(log_ratio, np.ones_like(log_ratio, dtype=bool))
    estimate = weighted_doubly_robust(v[STEPS, s[:, 0]], weights, temporal_errors(s, a, q, v), GAMMA)
    assert estimate == pytest.approx(exact, rel=0.02)


def test_the_exact_value_function_needs_fewer_sessions_than_none():
    q, v = exact_tables()
    none_q, none_v = np.zeros_like(q), np.zeros_like(v)
    spread = {True: [], False: []}
    for seed in range(60):
        s, a, log_ratio = logged(30, seed)
        weights = step_weights(log_ratio, np.ones_like(log_ratio, dtype=bool))
        for right in (True, False):
            q_, v_ = (q, v) if right else (none_q, none_v)
            spread[right].append(weighted_doubly_robust(v_[STEPS, s[:, 0]], weights, temporal_errors(s, a, q_, v_), GAMMA))
    assert np.std(spread[True]) < 0.75 * np.std(spread[False])


def test_weights_stay_finite_over_six_hundred_steps_and_sum_to_one_where_any_session_has_the_step():
    rng = np.random.default_rng(3)
    log_ratio, mask = rng.normal(-4, 5, (9, 600)), rng.random((9, 600)) > 0.2
    mask[:, 100] = False
    weights = step_weights(log_ratio, mask)
    np.testing.assert_allclose(weights.sum(0), mask.any(0))
    assert (weights[~mask] == 0).all()


def test_the_controller_that_made_the_data_gets_its_mean_return_whatever_the_value_function(small_buffer):
    constant = tuple(replace(s, beta=s.beta[:30], amplitude=s.amplitude[:30]) for s in small_buffer.sessions if s.controller == "cdbs")
    buffer = ReplayBuffer(small_buffer.settings, constant, "uV", "table")
    estimate = DoublyRobust(FqeConfig(members=1, refits=2)).fit(buffer).evaluate({"cdbs": ConstantPolicy(1.0)}, 30)["cdbs"]
    discount = buffer.settings.gamma ** np.arange(30)
    steps = np.mean([float(s.rewards(buffer.settings) @ discount) for s in constant])
    ends = np.mean([s.end_reward(buffer.settings) for s in constant])
    assert estimate.step_return == pytest.approx(steps, abs=0.05)
    assert estimate.end_reward == pytest.approx(ends, abs=0.3)


def test_few_effective_sessions_are_told_beside_the_value(small_buffer):
    estimate = DoublyRobust(FqeConfig(members=1, refits=2)).fit(small_buffer).evaluate({"half": ConstantPolicy(0.5)}, 40)["half"]
    flag = next(f for f in estimate.flags if f.code == "few_sessions_behind_correction")
    assert (flag.fact("sessions"), flag.limit, flag.refuses) == (9, 10, False)
    assert estimate.details["horizon_of_ten"] == 0


@pytest.mark.slow
def test_the_correction_keeps_the_order_of_policies_on_a_simulator(linear_simulator):
    buffer, policies, truth = linear_simulator.buffer(seed=0), linear_simulator.policies(), linear_simulator.truth()
    corrected = DoublyRobust().fit(buffer).evaluate(policies, 300)
    plain = Fqe().fit(buffer).evaluate(policies, 300)
    result = accuracy([truth[n][0] for n in truth], [corrected[n].step_return for n in truth])
    assert result.rank_correlation > 0.6
    assert any(corrected[n].step_return != plain[n].step_return for n in truth)
