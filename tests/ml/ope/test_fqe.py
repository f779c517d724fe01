"""Fitted Q evaluation against exact values: tabular MDPs by dynamic programming, simulators by Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.ope.compare.metrics import accuracy
from ml.ope.doses import fresh_memory, held_amplitude, memories
from ml.ope.fqe.estimator import Fqe, FqeConfig, backward_induction, discounts, logged_returns, minutes_of, spectral_radius, within_reach
from ml.ope.fqe.score import fqe_value
from ml.ope.fqe.steps import RATES, TargetActions, usable_steps
from ml.ope.outcomes.minutes import ABOVE, AMPLITUDE, BETA, ENERGY, step_features
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer

GO = np.array([[[0.75, 0.25], [0.5, 0.5]], [[0.25, 0.75], [0.5, 0.5]]])  # [s, a, s']
REWARD = np.array([[1.0, -0.5], [0.2, 2.0]])
TARGET = np.array([1, 0])  # the deterministic policy


def exact_q(horizon, gamma):
    """Compute Q_H(s, a) of the target policy by dynamic programming, [2, 2]."""
    q = np.zeros((2, 2))
    for _ in range(horizon):
        v = q[np.arange(2), TARGET]
        q = REWARD + gamma * GO @ v
    return q


def every_transition():
    """Repeat each (s, a, s') by its probability, one-hot over (s, a): features now, features under the policy then, rewards."""
    now, then, rewards = [], [], []
    for s in range(2):
        for a in range(2):
            for s2 in range(2):
                for _ in range(int(4 * GO[s, a, s2])):
                    now.append(np.eye(4)[2 * s + a])
                    then.append(np.eye(4)[2 * s2 + TARGET[s2]])
                    rewards.append([REWARD[s, a]])
    return np.array(now), np.array(then), np.array(rewards)


@pytest.mark.parametrize(("horizon", "gamma"), [(1, 0.9), (7, 0.9), (40, 1.0), (300, 0.99)])
def test_q_of_a_tabular_mdp_is_that_of_dynamic_programming_at_every_horizon(horizon, gamma):
    phi, then, rewards = every_transition()
    transition, reward = (np.linalg.solve(phi.T @ phi, phi.T @ x) for x in (then, rewards))
    weights = backward_induction(transition, reward, np.array([gamma]), horizon)
    np.testing.assert_allclose(weights[-1, :, 0].reshape(2, 2), exact_q(horizon, gamma), rtol=1e-9)


def test_the_matrix_recursion_is_the_regression_on_targets_of_the_textbook():
    rng = np.random.default_rng(0)
    phi, then, rewards = rng.normal(size=(80, 6)), 0.3 * rng.normal(size=(80, 6)), rng.normal(size=(80, RATES))
    ridge = 0.5 * np.eye(6)
    discount = discounts(0.9)
    slow = np.zeros((6, RATES))
    for _ in range(9):  # one ridge regression per step to go, its targets made from the one before
        targets = rewards + discount * (then @ slow)
        slow = np.linalg.solve(phi.T @ phi + ridge, phi.T @ targets)
    transition, reward = (np.linalg.solve(phi.T @ phi + ridge, phi.T @ x) for x in (then, rewards))
    np.testing.assert_allclose(backward_induction(transition, reward, discount, 9)[-1], slow, rtol=1e-9)


def test_rewards_are_discounted_and_what_outcomes_follow_is_averaged_over_the_horizon():
    step = step_features(np.array(7.0), np.array(0.4), 8.0)
    weights = backward_induction(np.ones((1, 1)), np.append(1.0, step)[None], discounts(0.99), 200)
    np.testing.assert_allclose(weights[-1, 0, 0], (1 - 0.99**200) / 0.01)
    minutes = minutes_of(weights[-1, 0], 200)
    np.testing.assert_allclose(minutes.means, step)
    np.testing.assert_allclose([minutes.means[k] for k in (AMPLITUDE, ENERGY, BETA, ABOVE)], [0.4, 0.16, 7.0, 0.0])


def test_sums_are_cut_to_what_amplitudes_within_the_span_can_add_up_to(simulator):
    settings = simulator.settings
    low, high = within_reach(np.array([np.full(RATES, -1e6), np.full(RATES, 1e6)]), settings, 50, (0.2, 1.5), (0.3, 0.8))
    inside = 50 * step_features(np.array([0.9]), np.array([0.5]), settings.xi_beta)[0]
    assert (low[1:] <= inside).all()
    assert (inside <= high[1:]).all()
    assert high[1 + AMPLITUDE] == pytest.approx(50 * 0.8)
    assert low[1 + ENERGY] == pytest.approx(50 * 0.09)


def test_policies_are_ranked_and_valued_on_two_unrelated_simulators(simulator):
    estimates = Fqe().fit(simulator.buffer(seed=0)).evaluate(simulator.policies(), 300)
    truth = simulator.truth()
    result = accuracy([sum(truth[n]) for n in truth], [estimates[n].value for n in truth])
    assert result.rank_correlation > 0.9
    assert result.regret_of_range < 0.1
    assert result.mae_of_range < 0.2
    assert all(0 <= e.predicted["energy"] <= 1 and 0 <= e.predicted["tremor_percent"] <= 100 for e in estimates.values())


def test_the_undiscounted_energy_of_a_constant_controller_is_its_amplitude_squared(linear_simulator):
    estimate = Fqe(FqeConfig(refits=4)).fit(linear_simulator.buffer(seed=2)).evaluate({"half": ConstantPolicy(0.5)}, 300)["half"]
    assert estimate.predicted["energy"] == pytest.approx(0.25, abs=0.01)
    assert estimate.predicted["mean_beta"] == pytest.approx((0.55 - 0.25 * 0.5) / 0.45, abs=0.03)


def test_the_same_seed_gives_the_same_estimate(small_buffer):
    one, two = (Fqe(FqeConfig(refits=4)).fit(small_buffer).evaluate({"half": ConstantPolicy(0.5)}, 30) for _ in range(2))
    assert one == two


def test_a_transition_that_would_grow_over_the_horizon_is_shrunk(small_buffer):
    wild = ProportionalPolicy(0.8, 0.9, 0.0)
    fitted = Fqe(FqeConfig(refits=2, members=1)).fit(small_buffer)
    member = replace(fitted.members[0], penalty=1e-12)
    products = member.next_products(TargetActions.of(fitted.table, wild))
    everything = np.arange(fitted.table.sessions)
    raw, _ = member.grams.solve(everything, 1e-12, products, member.grams.reward)
    weights, penalty = member.weights(products, everything, 600, 0.99)
    assert spectral_radius(raw) > 1.001
    assert penalty > 1e-12
    assert np.abs(weights[-1, 0, 1:4]).max() < 600 * 3


def test_a_sweep_score_orders_policies_like_the_truth_and_is_zero_in_r_end_without_outcomes(linear_simulator):
    buffer = linear_simulator.buffer(seed=0)
    train = replace(buffer, sessions=buffer.sessions[:14])
    truth = linear_simulator.truth()
    scores = {n: fqe_value(train, p, buffer.sessions[14:], 300) for n, p in linear_simulator.policies().items()}
    result = accuracy([truth[n][0] for n in truth], [scores[n].step_return for n in truth])
    assert result.rank_correlation > 0.8
    assert max(abs(s.residual) for s in scores.values()) < 0.5
    bare = replace(train, sessions=tuple(replace(s, qoc=Qoc()) for s in train.sessions))
    score = fqe_value(bare, ConstantPolicy(0.5), [], 100)
    assert score.end_reward == 0.0
    assert score.value == score.step_return


def test_memories_are_the_exponential_averages_of_the_amplitudes_so_far(small_buffer):
    session = small_buffer.sessions[0]
    gap = replace(session, amplitude=np.where(np.arange(session.steps) % 7 == 3, np.nan, session.amplitude))
    a = held_amplitude(gap)
    assert a[3] == a[2]
    slow = np.full(3, a[0])
    for value in a[1:]:
        slow = slow * np.array([0.8, 0.95, 0.985]) + (1 - np.array([0.8, 0.95, 0.985])) * value
    np.testing.assert_allclose(memories(a)[-1], slow)
    np.testing.assert_allclose(fresh_memory(a[:1])[0], a[0])


def test_logged_returns_are_the_discounted_sums_of_unbroken_steps(small_buffer):
    table = usable_steps(small_buffer)
    rows, returns = logged_returns(table, 0.9, 10)
    for row, value in zip(rows[::25], returns[::25], strict=True):
        assert table.session[row] == table.session[row + 9]
        assert value == pytest.approx(sum(0.9**j * table.rates[row + j, 0] for j in range(10)))
    expected = sum(max(0, s.steps - 9) for s in small_buffer.sessions)
    assert rows.size == expected


def test_padding_a_session_with_unusable_steps_changes_no_value(small_buffer):
    padded = tuple(
        replace(s, beta=np.r_[s.beta, np.full(9, np.nan)], amplitude=np.r_[s.amplitude, np.full(9, np.nan)]) for s in small_buffer.sessions
    )
    one, two = (
        Fqe(FqeConfig(refits=2, members=1))
        .fit(ReplayBuffer(small_buffer.settings, sessions, "uV", "table"))
        .evaluate({"half": ConstantPolicy(0.5)}, 40)["half"]
        for sessions in (small_buffer.sessions, padded)
    )
    assert one.step_return == pytest.approx(two.step_return)


def test_nothing_is_estimated_that_the_steps_of_the_policy_cannot_hold(small_buffer):
    found = Fqe(FqeConfig(members=1, refits=10)).fit(small_buffer).evaluate({"all": ConstantPolicy(1.0), "half": ConstantPolicy(0.5)}, 30)
    discounted = float(np.sum(small_buffer.settings.gamma ** np.arange(30)))
    for name, a in (("all", 1.0), ("half", 0.5)):
        assert found[name].predicted["mean_amplitude"] == pytest.approx(a)
        assert found[name].predicted["energy"] == pytest.approx(a**2)
        assert found[name].step_return <= -small_buffer.settings.c1 * a * discounted + 1e-9
