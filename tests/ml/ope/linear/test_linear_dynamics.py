"""The linear model of beta: levels, answer to the amplitude and autoregression against known systems."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.ope.doses import memories
from ml.ope.linear.dynamics import ANSWERS, LARGEST_ROOT, SessionTable, answers, fit_dynamics, noise_features
from ml.ope.linear.estimator import LinearConfig, LinearModel
from ml.ope.linear.held_out import block_error, mean_path, replay_skill
from ml.ope.scale import learn_scale, session_folds
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer, SessionTrajectory

W = 10
SETTINGS = MdpSettings(xi_beta=2.0, c2=0.0, c3=0.0, c4=0.0)


def known_system(seed, n=16, steps=400, phi=(0.5, 0.2), fall=0.8, day=0.3, session=0.2):
    """Simulate beta = 3 + day + session - fall x dose + AR(2); the dose is the average over about 20 steps. Random sessions, and cDBS."""
    rng = np.random.default_rng(seed)
    days, sessions, levels = day * rng.standard_normal(4), [], []
    for i in range(n):
        a = np.full(steps, 1.0) if i % 4 == 3 else rng.uniform(0.3, 1.0, steps)
        level = 3.0 + days[i // 4] + session * rng.standard_normal()
        eta = np.zeros(W + steps + 50)
        for t in range(2, eta.size):
            eta[t] = phi[0] * eta[t - 1] + phi[1] * eta[t - 2] + 0.15 * rng.standard_normal()
        dose = np.concatenate([np.full(W, memories(a)[0, 1]), memories(a)[:, 1]])
        beta = level - fall * dose + eta[50:]
        lower = None if i % 4 == 3 else 0.3
        kind = "cdbs" if lower is None else "random"
        sessions.append(SessionTrajectory(i, 1 + i // 4, kind, beta[:W], beta[W:], a, random_bound=lower))
        levels.append(level)
    return ReplayBuffer(SETTINGS, tuple(sessions), "uV", "table"), np.array(levels)


def fitted(buffer, draws=20):
    scale = learn_scale(buffer)
    tables = [SessionTable.of(s, scale) for s in buffer.sessions]
    return scale, tables, *fit_dynamics(buffer, tables, draws, 0)


def linear_scale(buffer):
    """Return the scale without the logarithm, so that the known constants can be read off."""
    return replace(learn_scale(buffer), log=False, beta_mean=0.0, beta_std=1.0)


def test_autoregression_answer_to_the_amplitude_and_levels_of_a_known_system_are_found():
    buffer, levels = known_system(0)
    tables = [SessionTable.of(s, linear_scale(buffer)) for s in buffer.sessions]
    main, drawn = fit_dynamics(buffer, tables, 300, 0)
    np.testing.assert_allclose(main.phi[:2], [0.5, 0.2], atol=0.05)
    assert np.abs(main.phi[2:]).max() < 0.06
    curve = np.array([0.4, 0.7, 1.0])
    said = answers(curve, np.tile(curve[:, None], (1, 3))) @ main.beta[0]
    assert said[0] - said[2] == pytest.approx(0.8 * 0.6, abs=0.1)
    assert np.corrcoef(main.levels[0], levels)[0, 1] > 0.95
    at_a_level = answers(np.array([0.4, 1.0]), np.array([[0.4] * 3, [1.0] * 3])) @ drawn.beta.T
    low, high = np.quantile(at_a_level[0] - at_a_level[1], (0.025, 0.975))
    assert low < 0.48 < high
    assert high - low < 0.5


def test_intervals_of_the_fall_of_beta_cover_it_as_often_as_they_say():
    hits = []
    for seed in range(40):
        buffer, _ = known_system(100 + seed, n=12, steps=150)
        tables = [SessionTable.of(s, linear_scale(buffer)) for s in buffer.sessions]
        _, drawn = fit_dynamics(buffer, tables, 200, seed)
        ends = answers(np.array([0.4, 1.0]), np.array([[0.4] * 3, [1.0] * 3])) @ drawn.beta.T
        low, high = np.quantile(ends[0] - ends[1], (0.05, 0.95))
        hits.append(low <= 0.48 <= high)
    assert np.mean(hits) >= 0.8


def test_innovations_of_a_fit_put_its_sessions_together_again():
    buffer, _ = known_system(1, n=4, steps=60)
    _, tables, main, _ = fitted(buffer)
    for i, (table, noise) in enumerate(zip(tables, main.innovations(tables), strict=True)):
        rest = table.answers @ main.beta[0] + main.levels[0, i]
        eta = list(table.beta[:W] - rest[:W])
        for t in range(60):
            predicted = rest[W + t] + np.dot(main.phi, eta[-1 : -W - 1 : -1])
            scale = np.exp(noise_features(table.amplitude[t : t + 1], np.array([predicted]))[0] @ main.noise_weights)
            eta.append(predicted + scale * noise[0, t] - rest[W + t])
        np.testing.assert_allclose(rest + eta, table.beta, atol=1e-9)


def test_steps_without_a_known_window_have_no_innovation_and_the_others_keep_theirs():
    buffer, _ = known_system(2, n=4, steps=80)
    gap = buffer.sessions[0].beta.copy()
    gap[30] = np.nan
    holed = replace(buffer, sessions=(replace(buffer.sessions[0], beta=gap), *buffer.sessions[1:]))
    tables = [SessionTable.of(s, learn_scale(holed)) for s in holed.sessions]
    noise = fit_dynamics(holed, tables, 3, 0)[1].innovations(tables)[0]
    assert noise.shape == (3, 80)
    assert np.isnan(noise[:, 30 : 30 + W + 1]).all()
    assert np.isfinite(noise[:, :30]).all()
    assert np.isfinite(noise[:, 30 + W + 1 :]).all()


def test_a_free_run_is_the_recursion_written_out():
    buffer, _ = known_system(3, n=4, steps=50)
    _, tables, main, _ = fitted(buffer)
    path = mean_path(main, tables[0], 0.3)
    rest = tables[0].answers @ main.beta[0] + 0.3
    window = list(tables[0].beta[:W])
    for t in range(50):
        expected = rest[W + t] + sum(main.phi[k] * (window[-1 - k] - rest[W + t - 1 - k]) for k in range(W))
        assert path[t] == pytest.approx(expected, abs=1e-9)
        window.append(expected)


def test_held_out_skill_is_that_of_block_means_of_sessions_that_were_not_learnt_from():
    strong, _ = known_system(4, fall=2.0, day=0.05, session=0.05)
    weak, _ = known_system(4, fall=0.0, day=0.05, session=0.6)
    folds = session_folds(strong.sessions, 4, 0)
    tables = [[SessionTable.of(s, learn_scale(buffer)) for s in buffer.sessions] for buffer in (strong, weak)]
    assert replay_skill(strong, tables[0], folds) > 0.5
    assert replay_skill(weak, tables[1], folds) < 0.3
    assert block_error(np.r_[np.ones(30), np.full(30, np.nan)], np.zeros(60)) == pytest.approx(1.0)


def test_the_answer_has_as_many_columns_as_the_model_says():
    assert answers(np.array([0.5]), np.array([[0.5, 0.5, 0.5]])).shape == (1, ANSWERS)
    np.testing.assert_allclose(answers(np.array([1.0]), np.ones((1, 3)))[0, 1:], 0.0, atol=1e-12)


def walking(seed, n=14, steps=200):
    """Simulate sessions whose level is their own and hardly moves, so that a one-step regression finds a root near one."""
    rng = np.random.default_rng(seed)
    sessions = []
    for i in range(n):
        lower = None if i % 7 > 4 else 0.3
        a = rng.uniform(0.3, 1.0, steps) if lower else np.full(steps, 1.0 if i % 7 == 5 else 0.35)
        level = rng.normal(0.0, 0.5) + 0.02 * np.cumsum(rng.normal(size=W + steps))
        dose = np.full(W + steps, 0.65)
        for k in range(W, W + steps):
            dose[k] = dose[k - 1] + 0.1 * (a[k - W] - dose[k - 1])
        beta = 3.0 + level - 1.0 * dose + 0.15 * rng.normal(size=W + steps)
        kind = "random" if lower else ("cdbs" if i % 7 == 5 else "other")
        sessions.append(SessionTrajectory(i, 1, kind, beta[:W], beta[W:], a, random_bound=lower))
    return ReplayBuffer(MdpSettings(xi_beta=2.35, c2=0.0, c3=0.0, c4=0.0), tuple(sessions), "uV", "table")


def test_a_root_near_one_is_kept_away_from_it_and_the_fall_of_beta_with_amplitude_is_not_lost():
    falls = []
    for seed in range(3):
        buffer = walking(seed)
        fitted = LinearModel(LinearConfig(draws=20)).fit(buffer)
        found = fitted.evaluate({"low": ConstantPolicy(0.4), "high": ConstantPolicy(0.9)}, 200)
        assert found["low"].details["largest_root"] <= LARGEST_ROOT + 1e-9
        falls.append(found["low"].predicted["mean_beta"] - found["high"].predicted["mean_beta"])
    assert 0.25 < np.mean(falls) < 0.9  # true: about 0.48
    assert min(falls) > 0.0


def test_the_reward_is_that_of_sampled_beta_never_of_its_mean(linear_simulator):
    # Mean beta at 0.65 is under the threshold; the share of steps above it does not vanish, and the step return must say so.
    buffer = linear_simulator.buffer(seed=1)
    quiet = tuple(replace(s, qoc=type(s.qoc)()) for s in buffer.sessions)
    fitted = LinearModel(LinearConfig(draws=20)).fit(replace(buffer, sessions=quiet))
    estimate = fitted.evaluate({"x": ConstantPolicy(0.65)}, 300)["x"]
    of_the_mean = -0.3 * 0.65 * float(np.sum(0.99 ** np.arange(300)))
    truth = linear_simulator.truth()["constant 0.65"][0]
    assert estimate.predicted["mean_beta"] < linear_simulator.xi + 0.05
    assert estimate.step_return == pytest.approx(truth, abs=3.0)
    assert abs(of_the_mean - truth) > 5.0


def test_a_bad_day_is_not_taken_for_a_bad_amplitude():
    # Every low session falls on the day of low beta: without a level of each visit, low amplitudes look good.
    rng = np.random.default_rng(0)
    sessions = []
    for i in range(16):
        visit = 1 + i % 2
        kind = "random" if i % 4 < 2 else ("other" if visit == 1 else "cdbs")
        a = rng.uniform(0.3, 1.0, 200) if kind == "random" else np.full(200, 0.35 if visit == 1 else 1.0)
        beta = 2.0 + (0.0 if visit == 1 else 0.8) + 0.1 * rng.normal(size=W + 200)
        for k in range(200):
            beta[W + k] -= 0.5 * a[k]
        lower = 0.3 if kind == "random" else None
        sessions.append(SessionTrajectory(i, visit, kind, beta[:W], beta[W:], a, random_bound=lower))
    buffer = ReplayBuffer(MdpSettings(xi_beta=2.0, c2=0.0, c3=0.0, c4=0.0), tuple(sessions), "uV", "table")
    found = LinearModel(LinearConfig(draws=20)).fit(buffer).evaluate({"low": ConstantPolicy(0.4), "high": ConstantPolicy(0.9)}, 200)
    fall = found["low"].predicted["mean_beta"] - found["high"].predicted["mean_beta"]
    assert fall == pytest.approx(0.25, abs=0.12)
