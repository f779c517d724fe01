from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ml.ope.compare.metrics import accuracy
from ml.ope.linear.dynamics import answers, noise_features
from ml.ope.linear.estimator import LinearConfig, LinearModel
from ml.ope.outcomes.minutes import by_minute
from ml.ope.outcomes.model import fit_end_model
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.qoc import Qoc, failed_qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory


def test_the_step_returns_of_a_known_linear_system_are_recovered(linear_simulator):
    estimates = LinearModel().fit(linear_simulator.buffer(seed=0)).evaluate(linear_simulator.policies(), 300)
    truth = linear_simulator.truth()
    result = accuracy([truth[n][0] for n in truth], [estimates[n].step_return for n in truth])
    assert result.mae_of_range < 0.03
    assert result.rank_correlation > 0.97


def test_policies_are_ranked_by_their_whole_return_also_where_a_slow_state_is_hidden(simulator):
    estimates = LinearModel().fit(simulator.buffer(seed=0)).evaluate(simulator.policies(), 300)
    truth = simulator.truth()
    result = accuracy([sum(truth[n]) for n in truth], [estimates[n].value for n in truth])
    assert result.rank_correlation > 0.9
    assert result.regret_of_range < 0.05
    assert result.mae_of_range < 0.12


def test_the_mean_beta_of_a_constant_controller_is_the_systems_resting_point(linear_simulator):
    fitted = LinearModel(LinearConfig(draws=20)).fit(linear_simulator.buffer(seed=2))
    estimate = fitted.evaluate({"half": ConstantPolicy(0.5)}, 400)["half"]
    assert estimate.predicted["mean_beta"] == pytest.approx((0.55 - 0.25 * 0.5) / 0.45, abs=0.02)
    assert estimate.predicted["energy"] == pytest.approx(0.25)
    json.dumps(estimate.to_json())


def test_a_policy_that_would_have_done_what_was_done_gets_back_what_was_observed(linear_simulator):
    # Innovations, levels and what outcomes had beyond the regression stay with their session: nothing is left to be modelled.
    policy = ProportionalPolicy(linear_simulator.xi - 0.2, linear_simulator.xi + 0.2, 0.3, 3)
    rng, settings, sessions = np.random.default_rng(7), linear_simulator.settings, []
    for k in range(6):
        beta, a, qoc = linear_simulator.run(rng, 1, 120, policy.act)
        own = Qoc(float(qoc[0, 0]), int(qoc[0, 1]), float(qoc[0, 2]))
        sessions.append(SessionTrajectory(k, 1 + k // 2, "rl", beta[0, :10], beta[0, 10:], a[0], qoc=own))
    fitted = LinearModel(LinearConfig(draws=20)).fit(ReplayBuffer(settings, tuple(sessions), "uV", "table"))
    replayed = fitted.replay([policy], fitted.drawn, fitted.ends, 120)
    _, actions = fitted.steps(policy, fitted.drawn, *fitted.beginning(fitted.drawn, 120))
    discount = settings.gamma ** np.arange(120)
    for k, s in enumerate(sessions):
        np.testing.assert_allclose(actions[:, :, k], np.tile(s.amplitude[:, None], (1, 20)), atol=1e-9)
        np.testing.assert_allclose(replayed.step_return[0, :, k], s.rewards(settings) @ discount)
        np.testing.assert_allclose(replayed.outcomes[0, :, k, 0], s.end_reward(settings))
        np.testing.assert_allclose(replayed.outcomes[0, :, k, 3], s.qoc.tremor_percent)


def test_all_sessions_policies_and_draws_together_are_each_replayed_alone(small_buffer):
    fitted = LinearModel(LinearConfig(draws=20)).fit(small_buffer)
    policies = [ConstantPolicy(0.4), ProportionalPolicy(0.7, 1.0, 0.2, 2)]
    fast, model, settings = fitted.replay(policies, fitted.drawn, fitted.ends, 30), fitted.drawn, small_buffer.settings
    for p, policy in enumerate(policies):
        _, actions = fitted.steps(policy, model, *fitted.beginning(model, 30))
        for d in (0, 7):
            for i, table in enumerate(fitted.tables):
                noise = model.innovations(fitted.tables)[i][d]
                window, memory, eta, beta, chosen = list(table.beta[:10]), None, None, [], []
                for t in range(30):
                    a = policy.act(fitted.scale.raw_beta(np.array([window])))
                    if memory is None:
                        before = a if np.isnan(model.before[i]) else model.before[i : i + 1]
                        memory = np.tile(before, 3)
                        lasting = float(answers(before, memory[None])[0] @ model.beta[d] + model.levels[d, i])
                        eta = [v - lasting for v in window]
                    memory = np.array([0.8, 0.95, 0.985]) * memory + np.array([0.2, 0.05, 0.015]) * a
                    rest = float(answers(a, memory[None])[0] @ model.beta[d] + model.levels[d, i])
                    predicted = rest + sum(model.phi[k] * eta[-1 - k] for k in range(10))
                    newest = predicted + np.exp(noise_features(a, np.array([predicted]))[0] @ model.noise_weights) * noise[t]
                    eta, window = [*eta, newest - rest], [*window[1:], newest]
                    beta.append(float(fitted.scale.raw_beta(np.array(newest))))
                    chosen.append(float(a[0]))
                np.testing.assert_allclose(actions[:, d, i], chosen, atol=1e-9)
                steps = [
                    settings.gamma**t * (-(b >= settings.xi_beta) - settings.c1 * a)
                    for t, (b, a) in enumerate(zip(beta, chosen, strict=True))
                ]
                assert fast.step_return[p, d, i] == pytest.approx(sum(steps), abs=1e-9)


def test_intervals_of_step_returns_cover_the_truth_about_as_often_as_they_say(linear_simulator):
    policies = {k: v for k, v in linear_simulator.policies().items() if k in ("constant 0.65", "middle", "eager")}
    truth = linear_simulator.truth(horizon=100)
    hits, widths = [], []
    for seed in range(12):
        bare = tuple(replace(s, qoc=Qoc()) for s in linear_simulator.buffer(seed=10 + seed, n=14, steps=100).sessions)
        buffer = ReplayBuffer(linear_simulator.settings, bare, "uV", "table")
        estimates = LinearModel(LinearConfig(draws=40)).fit(buffer).evaluate(policies, 100)
        hits += [estimates[n].low <= truth[n][0] <= estimates[n].high for n in policies]
        widths += [estimates[n].high - estimates[n].low for n in policies]
    # 90 % intervals: neither too narrow, nor so wide that they say nothing
    assert np.mean(hits) >= 0.75
    assert np.median(widths) < 0.4 * np.ptp([truth[n][0] for n in truth])


def test_the_same_seed_gives_the_same_estimate(small_buffer):
    policies = {"half": ConstantPolicy(0.5)}
    one, two = (LinearModel(LinearConfig(draws=20)).fit(small_buffer).evaluate(policies, 30) for _ in range(2))
    assert one == two


def test_outcomes_that_follow_the_mean_amplitude_are_learnt_and_kept_in_their_range(linear_simulator):
    sessions = []
    for k, s in enumerate(linear_simulator.buffer(seed=4, n=24, steps=60).sessions):
        level = 0.3 + 0.7 * k / 23
        qoc = Qoc(1.0 + level, 5, min(100.0, 120.0 * level))
        sessions.append(replace(s, amplitude=np.full(s.steps, level), qoc=qoc))
    model = fit_end_model(ReplayBuffer(linear_simulator.settings, tuple(sessions), "uV", "table"))
    beta = np.full((2, 60), 0.9)
    predicted = model.predict(by_minute(beta, np.array([[0.5] * 60, [1.0] * 60]), linear_simulator.settings))
    assert predicted[0, 1] == pytest.approx(1.5, abs=0.12)
    assert predicted[1, 1] == pytest.approx(2.0, abs=0.12)
    assert predicted[:, 2] == pytest.approx(5.0, abs=0.3)
    assert (predicted[:, 3] <= 100).all()
    assert model.by_session.skill[1] > 0.9


def test_a_buffer_without_outcomes_still_gives_a_step_return(small_buffer):
    bare = tuple(replace(s, qoc=Qoc()) for s in small_buffer.sessions)
    fitted = LinearModel(LinearConfig(draws=20)).fit(ReplayBuffer(small_buffer.settings, bare, "uV", "table"))
    estimate = fitted.evaluate({"half": ConstantPolicy(0.5)}, 30)["half"]
    assert estimate.end_reward is None
    assert estimate.value == estimate.step_return


def test_where_no_qoc_counts_the_return_is_that_of_the_steps_and_nothing_is_missing(small_buffer):
    nothing = replace(small_buffer, settings=replace(small_buffer.settings, c2=0.0, c3=0.0, c4=0.0))
    estimate = LinearModel(LinearConfig(draws=20)).fit(nothing).evaluate({"half": ConstantPolicy(0.5)}, 30)["half"]
    assert (estimate.end_reward, estimate.value) == (0.0, estimate.step_return)
    assert "few_end_rewards" not in {f.code for f in estimate.flags}
    assert {"grasp_hz", "rating", "tremor_percent"} <= estimate.predicted.keys()


def test_a_stopped_session_lowers_the_estimate_and_the_flag_says_what_it_would_be_as_measured(linear_simulator):
    whole = linear_simulator.buffer(seed=3, n=12, steps=60)
    worst = failed_qoc(s.qoc for s in whole.sessions)
    sessions = tuple(replace(s, stopped_as=worst if s.controller == "other" else None) for s in whole.sessions)
    policies = {"low": ConstantPolicy(0.3)}
    before = LinearModel(LinearConfig(draws=20)).fit(whole).evaluate(policies, 60)["low"]
    after = LinearModel(LinearConfig(draws=20)).fit(replace(whole, sessions=sessions)).evaluate(policies, 60)["low"]
    assert after.end_reward < before.end_reward - 5
    flag = next(f for f in after.flags if f.code == "stopped_sessions")
    assert flag.value == 1
    assert flag.fact("counted") == pytest.approx(after.end_reward)
    assert flag.fact("measured") == pytest.approx(before.end_reward, abs=0.5)  # visits are weighted again
    assert "stopped_sessions" not in {f.code for f in before.flags}


def test_one_session_is_too_few(small_buffer):
    with pytest.raises(ValueError, match="at least two sessions"):
        LinearModel().fit(ReplayBuffer(small_buffer.settings, small_buffer.sessions[:1], "uV", "table"))
