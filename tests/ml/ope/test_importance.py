from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import truncnorm

from ml.ope.behaviour import clone, clones, rule_of_thumb_bandwidth
from ml.ope.importance import (
    ImportanceSampling,
    behaviour_log_density,
    consistent_weighted_per_decision,
    horizon_of_ten,
    kernel_log_density,
    ordinary,
    per_decision_terms,
    per_trajectory,
    weighted,
)
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.trajectories import ReplayBuffer


def textbook(log_ratio, mask, rewards, end, gamma):
    """Compute per-trajectory, self-normalised and per-decision estimates by the loops of a textbook, in linear space."""
    weights, returns, decisions = [], [], []
    for i in range(len(rewards)):
        w, g, d = 1.0, 0.0, 0.0
        for t in range(rewards.shape[1]):
            if mask[i, t]:
                w *= math.exp(log_ratio[i, t])
            g += gamma**t * rewards[i, t]
            d += gamma**t * w * rewards[i, t]
        weights.append(w)
        returns.append(g + end[i])
        decisions.append(d)
    total = sum(w * g for w, g in zip(weights, returns, strict=True))
    return total / len(weights), total / sum(weights), decisions


@pytest.mark.parametrize(("n", "steps", "gamma"), [(1, 1, 0.5), (6, 9, 0.99), (20, 40, 0.9), (5, 12, 0.0)])
def test_the_vectorised_estimates_are_those_of_the_textbooks_loops(n, steps, gamma):
    rng = np.random.default_rng(n)
    log_ratio, rewards = 0.3 * rng.normal(size=(n, steps)), rng.normal(size=(n, steps))
    mask, end = np.ones((n, steps), dtype=bool), rng.normal(size=n)
    expected = textbook(log_ratio, mask, rewards, end, gamma)
    log_weights, returns = per_trajectory(log_ratio, mask, rewards, end, gamma)
    assert ordinary(log_weights, returns) == pytest.approx(expected[0])
    assert weighted(log_weights, returns) == pytest.approx(expected[1])
    np.testing.assert_allclose(per_decision_terms(log_ratio, mask, rewards, gamma), expected[2])


def tabular(n, seed):
    """Simulate sessions of a two-state, two-action chain under a uniform behaviour, with the log ratios of a target policy."""
    target = np.array([[0.8, 0.2], [0.3, 0.7]])
    go = np.array([[[0.9, 0.1], [0.4, 0.6]], [[0.5, 0.5], [0.2, 0.8]]])
    reward = np.array([[1.0, -0.5], [0.2, 2.0]])
    steps, gamma = 4, 0.9
    rng = np.random.default_rng(seed)
    s, log_ratio, rewards = np.zeros(n, dtype=int), np.zeros((n, steps)), np.zeros((n, steps))
    for t in range(steps):
        a = rng.integers(0, 2, n)
        log_ratio[:, t], rewards[:, t] = np.log(target[s, a] / 0.5), reward[s, a]
        s = (rng.random(n) < go[s, a, 1]).astype(int)
    end = 3.0 * s
    p, exact = np.array([1.0, 0.0]), 0.0
    for t in range(steps):
        exact += gamma**t * float(np.sum(p[:, None] * target * reward))
        p = np.einsum("s,sa,sax->x", p, target, go)
    return log_ratio, rewards, end, gamma, exact, 3.0 * p[1]


def test_all_three_estimates_reach_the_exact_value_of_a_tabular_mdp_with_an_end_reward():
    log_ratio, rewards, end, gamma, steps_exact, end_exact = tabular(200_000, 0)
    mask = np.ones_like(rewards, dtype=bool)
    log_weights, returns = per_trajectory(log_ratio, mask, rewards, end, gamma)
    exact = steps_exact + end_exact
    assert ordinary(log_weights, returns) == pytest.approx(exact, rel=0.02)
    assert weighted(log_weights, returns) == pytest.approx(exact, rel=0.02)
    assert per_decision_terms(log_ratio, mask, rewards, gamma).mean() == pytest.approx(steps_exact, rel=0.02)
    assert ordinary(log_weights, end) == pytest.approx(end_exact, rel=0.03)


def test_per_decision_estimates_vary_less_than_per_trajectory_ones():
    log_ratio, rewards, end, gamma, _, _ = tabular(20_000, 1)
    mask = np.ones_like(rewards, dtype=bool)
    log_weights, returns = per_trajectory(log_ratio, mask, rewards, 0 * end, gamma)
    assert per_decision_terms(log_ratio, mask, rewards, gamma).std() < (np.exp(log_weights) * returns).std()


@pytest.mark.parametrize("drift", [-3.0, 0.0, 3.0])
def test_everything_stays_finite_at_six_hundred_steps_and_the_weighted_mean_stays_within_the_returns(drift):
    rng = np.random.default_rng(2)
    log_ratio = drift + 2 * rng.normal(size=(8, 600))
    rewards, mask = -rng.random((8, 600)), np.ones((8, 600), dtype=bool)
    log_weights, returns = per_trajectory(log_ratio, mask, rewards, np.zeros(8), 0.99)
    assert np.isfinite(ordinary(log_weights, returns))
    assert np.isfinite(per_decision_terms(log_ratio, mask, rewards, 0.99)).all()
    assert returns.min() <= weighted(log_weights, returns) <= returns.max()


def test_steps_after_a_short_session_count_as_the_mean_of_the_others():
    log_ratio, rewards = np.zeros((3, 4)), np.array([[1.0, 1, 1, 1], [3.0, 3, 3, 3], [2.0, 2, 9, 9]])
    mask = np.array([[1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 0, 0]], dtype=bool)
    np.testing.assert_allclose(per_decision_terms(log_ratio, mask, rewards, 1.0), [4.0, 12.0, 2 + 2 + 2 + 2])
    _, returns = per_trajectory(log_ratio, mask, rewards, np.zeros(3), 1.0 - 1e-12)
    np.testing.assert_allclose(returns, [4.0, 12.0, 8.0], rtol=1e-9)


@pytest.mark.parametrize("centre", [0.0, 0.35, 0.97, 1.0])
def test_the_kernel_is_a_truncated_normal_that_integrates_to_one(centre):
    low, high = -centre / 0.1, (1 - centre) / 0.1
    at = np.array([0.02, 0.5, 0.99])
    np.testing.assert_allclose(
        kernel_log_density(at, np.full(3, centre), 0.1), truncnorm.logpdf(at, low, high, loc=centre, scale=0.1), rtol=1e-6
    )
    total, _ = quad(
        lambda a: float(np.exp(kernel_log_density(np.array(a), np.array(centre), 0.1))), 0, 1, points=[max(centre - 0.2, 0), centre]
    )
    assert total == pytest.approx(1.0, abs=1e-6)


def test_the_density_of_a_random_session_is_known_and_a_like_acting_controller_has_ratio_one(small_buffer):
    random = next(s for s in small_buffer.sessions if s.controller == "random")
    np.testing.assert_allclose(behaviour_log_density(random, 0.1), np.log(1 / 0.7))
    constant = [s for s in small_buffer.sessions if s.controller == "cdbs"]
    buffer = ReplayBuffer(small_buffer.settings, tuple(constant), "uV", "table")
    log_ratio, mask, _ = ImportanceSampling("wis").fit(buffer).log_ratios(ConstantPolicy(1.0), 30)
    np.testing.assert_allclose(log_ratio[mask], 0.0, atol=1e-12)


@pytest.mark.parametrize("method", ["is", "wis", "pdis", "cwpdis"])
def test_evaluating_the_controller_that_made_the_data_gives_its_mean_return(small_buffer, method):
    constant = tuple(replace(s, beta=s.beta[:30], amplitude=s.amplitude[:30]) for s in small_buffer.sessions if s.controller == "cdbs")
    buffer = ReplayBuffer(small_buffer.settings, constant, "uV", "table")
    estimate = ImportanceSampling(method).fit(buffer).evaluate({"cdbs": ConstantPolicy(1.0)}, 30)["cdbs"]
    discount = buffer.settings.gamma ** np.arange(30)
    expected = np.mean([float(s.rewards(buffer.settings) @ discount) + s.end_reward(buffer.settings) for s in constant])
    assert estimate.value == pytest.approx(expected)
    assert estimate.details["effective_sample_size"] == pytest.approx(len(constant))


def test_an_estimate_shows_its_bandwidth_and_that_its_weights_rest_on_few_sessions(small_buffer):
    estimate = ImportanceSampling("pdis", bandwidth=0.05).fit(small_buffer).evaluate({"half": ConstantPolicy(0.5)}, 40)["half"]
    assert estimate.details["bandwidth"] == 0.05
    assert not estimate.supported
    flag = next(f for f in estimate.flags if f.code == "few_effective_sessions")
    assert (flag.fact("sessions"), flag.limit, flag.refuses) == (9, 10, True)


def test_sessions_of_unknown_density_can_be_left_out_and_none_left_is_an_error(small_buffer):
    fitted = ImportanceSampling("wis", only_random=True).fit(small_buffer)
    assert fitted.evaluate({"half": ConstantPolicy(0.5)}, 40)["half"].details["sessions_left_out"] == 6
    cdbs = tuple(s for s in small_buffer.sessions if s.controller == "cdbs")
    with pytest.raises(ValueError, match="no session to weigh"):
        ImportanceSampling("wis", only_random=True).fit(ReplayBuffer(small_buffer.settings, cdbs, "uV", "table"))


def slow_cwpdis(log_ratio, mask, rewards, gamma):
    """Compute the weighted mean reward of each step, in linear space, by loops."""
    total = 0.0
    for t in range(rewards.shape[1]):
        above = below = 0.0
        for i in range(len(rewards)):
            if mask[i, t]:
                w = math.exp(sum(log_ratio[i, j] for j in range(t + 1) if mask[i, j]))
                above, below = above + w * rewards[i, t], below + w
        total += gamma**t * above / below
    return total


def test_the_consistent_weighted_estimate_is_that_of_loops_also_with_gaps():
    rng = np.random.default_rng(5)
    log_ratio, rewards, mask = 0.4 * rng.normal(size=(7, 30)), rng.normal(size=(7, 30)), rng.random((7, 30)) > 0.3
    mask[0] = True
    fast = consistent_weighted_per_decision(log_ratio, mask, rewards, 0.95)
    assert fast == pytest.approx(slow_cwpdis(log_ratio, mask, rewards, 0.95))


def test_the_consistent_weighted_estimate_reaches_the_exact_value_of_a_tabular_mdp():
    log_ratio, rewards, _, gamma, exact, _ = tabular(200_000, 3)
    mask = np.ones_like(rewards, dtype=bool)
    assert consistent_weighted_per_decision(log_ratio, mask, rewards, gamma) == pytest.approx(exact, rel=0.02)


def test_a_padded_batch_gives_what_its_unpadded_members_give():
    rng = np.random.default_rng(6)
    log_ratio, rewards, mask = rng.normal(size=(5, 12)), rng.normal(size=(5, 12)), np.ones((5, 12), dtype=bool)

    def padded(x, fill):
        return np.concatenate([x, np.full((5, 8), fill)], axis=1)

    one = per_trajectory(log_ratio, mask, rewards, np.zeros(5), 1 - 1e-15)[0]
    two = per_trajectory(padded(log_ratio, 3.0), padded(mask, False), padded(rewards, 9.0), np.zeros(5), 1 - 1e-15)[0]
    np.testing.assert_allclose(one, two)
    cumulative = np.cumsum(log_ratio, axis=1)
    assert horizon_of_ten(log_ratio, mask) == 0
    short = consistent_weighted_per_decision(log_ratio, mask, rewards, 0.9)
    long = consistent_weighted_per_decision(padded(log_ratio, 3.0), padded(mask, False), padded(rewards, 9.0), 0.9)
    weights = np.exp(cumulative - cumulative.max(0))
    mean = ((weights * rewards).sum(0) / weights.sum(0)).mean()
    assert long - short == pytest.approx(mean * 0.9**12 * (1 - 0.9**8) / 0.1)


def test_weights_of_a_hundred_and_fifty_narrow_kernels_give_a_weighted_mean_of_returns_where_linear_space_gives_zero():
    # SCOPE-RL 0.2.1: cumulative products in linear space, self-normalised by mean + 1e-10, returned -6e-138 here.
    rng = np.random.default_rng(8)
    a, rewards = rng.uniform(0.3, 1.0, (20, 150)), -rng.random((20, 150))
    log_ratio = kernel_log_density(a, np.full_like(a, 0.5), 0.1) - np.log(1 / 0.7)
    ratios = np.exp(log_ratio).prod(axis=1)
    linear_space = float((ratios / (ratios.mean() + 1e-10) * rewards.sum(1)).mean())
    mask = np.ones_like(a, dtype=bool)
    log_weights, returns = per_trajectory(log_ratio, mask, rewards, np.zeros(20), 1 - 1e-15)
    assert abs(linear_space) < 1e-6
    assert returns.min() <= weighted(log_weights, returns) <= returns.max() < -50


def test_a_cloned_controller_acts_like_the_one_that_was_logged_and_its_density_is_estimated(small_buffer):
    rng = np.random.default_rng(0)
    states = rng.normal(1.0, 0.3, (2000, 10))
    policy = ProportionalPolicy(0.6, 1.4, 0.3, 3)
    copy, spread = clone(states, policy.act(states))
    fresh = rng.normal(1.0, 0.3, (500, 10))
    assert np.abs(copy.act(fresh) - policy.act(fresh)).mean() < 0.03
    assert spread < 0.05
    found = clones(small_buffer)
    assert found[("cdbs", None)][1] == 0.0
    assert found[("random", None)][0].act(states).min() >= 0.3
    session = next(s for s in small_buffer.sessions if s.controller == "rl")
    assert np.isfinite(behaviour_log_density(session, 0.1, found[("rl", None)])).all()
    with pytest.raises(ValueError, match="no known density"):
        behaviour_log_density(session, 0.1)


def test_the_bandwidth_follows_its_stated_rule_unless_given(small_buffer):
    expected = 1.06 * small_buffer.transitions().actions.std() * 9 ** (-0.2)
    assert rule_of_thumb_bandwidth(small_buffer) == pytest.approx(expected)
    assert ImportanceSampling("wis").fit(small_buffer).bandwidth == pytest.approx(expected)
    assert ImportanceSampling("wis", bandwidth=0.2).fit(small_buffer).bandwidth == 0.2


def test_an_estimate_has_a_bca_interval_beside_the_percentiles_from_three_sessions_on(small_buffer):
    estimate = ImportanceSampling("cwpdis").fit(small_buffer).evaluate({"half": ConstantPolicy(0.5)}, 40)["half"]
    low, high = estimate.details["bca"]
    assert low < high
    assert low <= max(estimate.details["draws"])
    assert high >= min(estimate.details["draws"])
    two = replace(small_buffer, sessions=small_buffer.sessions[:2])
    assert ImportanceSampling("wis").fit(two).evaluate({"half": ConstantPolicy(0.5)}, 40)["half"].details["bca"] is None
