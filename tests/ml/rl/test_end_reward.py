from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.ope.outcomes.minutes import of_buffer
from ml.ope.outcomes.model import fit_end_model
from ml.ope.outcomes.steps import end_reward_by_step
from ml.qoc import Qoc
from ml.rl import ALGORITHMS, HeldOutSessions, fit_end_reward, train
from ml.trajectories import ReplayBuffer, SessionTrajectory

SETTINGS = MdpSettings(xi_beta=1.0)


def buffer(grasp, sessions=16, steps=60, seed=0):
    """Simulate random amplitudes around a level of each session, beta without memory; `grasp(a, beta)` is the session's only QoC."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(sessions):
        a = np.clip(0.2 + 0.6 * k / (sessions - 1) + rng.uniform(-0.2, 0.2, steps), 0, 1)
        beta = 0.5 + rng.uniform(0, 1, steps)
        qoc = Qoc(grasp_hz=float(grasp(a, beta)), rating=5, tremor_percent=0.0)
        made.append(SessionTrajectory(k, 1, "random", rng.uniform(0.5, 1.5, 10), beta, a, qoc, 0.0))
    return ReplayBuffer(SETTINGS, tuple(made), "uV", "table")


def test_the_shares_of_a_session_add_up_to_its_end_reward_where_that_is_linear_in_them():
    data = buffer(lambda a, beta: 1.0 + a.mean() - 0.5 * (beta >= 1.0).mean())
    share = fit_end_reward(data)
    assert share is not None
    assert share.skill > 0.99
    for session in data.sessions:
        assert told_of(share, session) == pytest.approx(session.end_reward(SETTINGS), abs=0.3)


def test_slopes_beyond_what_any_patient_has_are_drawn_in_and_keep_their_order():
    # 2 Hz by the dose and 3 Hz by burden, the second against its sign: both 1.75 to 2.5 standard deviations of their priors away
    data = buffer(lambda a, beta: 1.0 + 2.0 * a.mean() + 3.0 * (beta >= 1.0).mean())
    share = fit_end_reward(data)
    assert share is not None
    assert share.skill > 0.95
    true = [session.end_reward(SETTINGS) for session in data.sessions]
    told = [told_of(share, session) for session in data.sessions]
    assert told == pytest.approx(true, abs=1.0)
    assert 0.9 < np.polyfit(true, told, 1)[0] < 1.0
    assert np.corrcoef(true, told)[0, 1] > 0.99


def test_shares_and_step_rewards_stand_in_the_proportion_of_the_return():
    data = buffer(lambda a, beta: 1.0 + 2.0 * a.mean())
    share = fit_end_reward(data)
    assert share is not None
    gamma, horizon = SETTINGS.gamma, data.median_steps()
    # a step reward of 1 counts (1 - gamma^H) / (1 - gamma) in the return, 1 / (1 - gamma) for a critic; r_end counts once in the return
    steps_for_critic, steps_in_return = 1 / (1 - gamma), (1 - gamma**horizon) / (1 - gamma)
    end_for_critic = share.factor / (1 - gamma)
    assert end_for_critic / steps_for_critic == pytest.approx(1 / steps_in_return)


def told_of(share, session):
    """Compute the r_end that the share gives a session."""
    return float(share.per_step(session).mean()) / share.factor


def told_at(share, level):
    """Compute the r_end that the share gives a session at a constant amplitude, beta at 0.5."""
    return told_of(share, SessionTrajectory(0, 1, "other", np.full(10, 0.5), np.full(20, 0.5), np.full(20, float(level))))


def test_a_good_day_that_chanced_upon_low_amplitudes_is_not_taken_for_their_merit():
    # within a day every tenth of amplitude brings 1 of r_end; the first day, with most of the low amplitudes, is 8 better than the last
    data = buffer(lambda a, beta: 1.0 + a.mean(), sessions=18)
    visits = [1, 1, 1, 2, 1, 1, 2, 1, 2, 2, 3, 2, 3, 3, 2, 3, 3, 3]
    good, rng = {1: 0.8, 2: 0.4, 3: 0.0}, np.random.default_rng(2)
    moved = [
        replace(s, visit=v, qoc=replace(s.qoc, grasp_hz=s.qoc.grasp_hz + good[v] + 0.1 * rng.standard_normal()))
        for s, v in zip(data.sessions, visits, strict=True)
    ]
    share = fit_end_reward(replace(data, sessions=tuple(moved)))
    assert share is not None
    assert told_at(share, 0.8) - told_at(share, 0.2) == pytest.approx(6.0, abs=3.0)
    assert share.visit_skill < 0 < share.skill, "days that differ so much cannot be foretold"
    as_one_day = fit_end_reward(replace(data, sessions=tuple(replace(s, visit=1) for s in moved)))
    line = np.polyfit([s.amplitude.mean() for s in moved], [s.end_reward(SETTINGS) for s in moved], 1)
    assert as_one_day is not None
    assert as_one_day.visit_skill is None
    hidden = told_at(as_one_day, 0.8) - told_at(as_one_day, 0.2)
    assert hidden == pytest.approx(0.6 * line[0], abs=1.0), "without days it tells what a line through all sessions tells"
    assert hidden < 0, "over all days together the good day turns round what the amplitude brings"


def test_a_noisy_rating_does_not_drown_what_the_grasp_tells():
    rng = np.random.default_rng(8)
    data = buffer(lambda a, beta: 1.0 + 2.0 * a.mean(), sessions=24)
    noisy = tuple(replace(s, qoc=replace(s.qoc, rating=int(rng.integers(4, 8)))) for s in data.sessions)
    share = fit_end_reward(replace(data, sessions=noisy))
    assert share is not None
    assert told_at(share, 0.8) - told_at(share, 0.2) == pytest.approx(12.0, abs=4.0)


def test_what_only_left_out_visits_show_is_shared_too():
    rng = np.random.default_rng(24)
    data = buffer(lambda a, beta: 1.5 + 0.4 * a.mean() + 0.25 * rng.standard_normal(), sessions=18, seed=24)
    visits = rng.permutation(18) % 3
    share = fit_end_reward(replace(data, sessions=tuple(replace(s, visit=int(v)) for s, v in zip(data.sessions, visits, strict=True))))
    assert share is not None
    assert share.skill < 0 < share.visit_skill
    assert told_at(share, 0.8) > told_at(share, 0.2)


def test_without_enough_sessions_or_without_any_relation_nothing_is_shared():
    few = buffer(lambda a, beta: a.mean(), sessions=7)
    assert fit_end_reward(few) is None
    rng = np.random.default_rng(5)
    assert fit_end_reward(buffer(lambda a, beta: rng.uniform(1, 3), sessions=40)) is None
    weightless = replace(buffer(lambda a, beta: a.mean()), settings=replace(SETTINGS, c2=0.0, c3=0.0, c4=0.0))
    assert fit_end_reward(weightless) is None


def test_steps_with_a_gap_have_no_share():
    data = buffer(lambda a, beta: 1 + a.mean())
    broken = data.sessions[0].beta.copy()
    broken[3] = np.nan
    share = fit_end_reward(data)
    assert share is not None
    told = share.per_step(replace(data.sessions[0], beta=broken))
    assert np.isnan(told[3])
    assert np.isfinite(np.delete(told, 3)).all()


def test_a_dose_is_worth_more_in_minutes_of_high_beta_where_tremor_goes_by_both():
    # tremor comes where beta is high and the dose low: the dose has nothing to improve in quiet minutes
    rng, made = np.random.default_rng(4), []
    for k in range(36):
        a = np.full(300, rng.uniform(0, 1))
        burst = np.repeat(rng.uniform(size=10) < 0.5, 30)
        beta = np.where(burst, 1.5, 0.5) + 0.1 * rng.standard_normal(300)
        shakes = burst.reshape(10, 30).any(1) & (rng.uniform(size=10) > a[0])
        qoc = Qoc(grasp_hz=2.0, rating=5, tremor_percent=100.0 * shakes.mean())
        made.append(SessionTrajectory(k, 1 + k // 12, "random", beta[:10], beta, a, qoc, 0.0))
    share = fit_end_reward(ReplayBuffer(SETTINGS, tuple(made), "uV", "table"))
    assert share is not None

    def worth(beta):
        """Compute what the whole dose adds over none, r_end units."""
        told = []
        for level in (0.0, 1.0):
            session = SessionTrajectory(0, 1, "other", np.full(10, beta), np.full(300, beta), np.full(300, level))
            told.append(share.per_step(session).mean() / share.factor)
        return told[1] - told[0]

    assert worth(1.5) > 1.5 * worth(0.5) > 0


def test_shares_of_a_session_have_the_mean_that_the_model_expects_of_it():
    rng, made = np.random.default_rng(6), []
    for k in range(24):
        a, beta = np.repeat(rng.uniform(0, 1, 10), 30), 0.5 + rng.uniform(0, 1, 300)
        eta = 2 - 4 * a.reshape(10, 30).mean(1)
        qoc = Qoc(
            grasp_hz=1.5 + 0.5 * float(a.mean()),
            rating=int(np.clip(round(3 + 5 * a.mean()), 1, 10)),
            tremor_percent=100 * float((rng.uniform(size=10) < 1 / (1 + np.exp(-eta))).mean()),
        )
        made.append(SessionTrajectory(k, 1 + k // 8, "random", beta[:10], beta, a, qoc, 0.0))
    data = ReplayBuffer(SETTINGS, tuple(made), "uV", "table")
    model = fit_end_model(data)
    minutes = of_buffer(data)
    expected = model.predict(replace(minutes, late=minutes.share))[:, 0]
    for k, session in enumerate(data.sessions):
        assert end_reward_by_step(model, session, SETTINGS).mean() == pytest.approx(expected[k], abs=1e-6)


@pytest.mark.parametrize("name", ["ddpg", "td3_bc"])
def test_a_policy_that_learns_for_the_return_spends_amplitude_where_the_end_rewards_it_and_else_saves_it(name):
    # beta does not answer to the amplitude: step rewards alone say 0; every tenth of amplitude brings 5 of r_end
    data = buffer(lambda a, beta: 1.0 + 5.0 * a.mean(), steps=80)
    algorithm = ALGORITHMS[name]
    states = data.transitions().states
    means = {}
    for aim in ("steps", "return"):
        config = algorithm.config(aim=aim, hidden=(24, 16), updates=600, actor_lr=1e-3, seed=1)
        means[aim] = float(train(data, config).policy.act(states).mean())
    assert means["steps"] < 0.35
    assert means["return"] > 0.65


def test_held_out_returns_hold_the_share_too_so_that_values_are_compared_with_their_like():
    data = buffer(lambda a, beta: 1.0 + 2.0 * a.mean())
    share = fit_end_reward(data)
    watched = HeldOutSessions(sessions=data)
    _, plain = watched.starts()
    _, shared = replace(watched, end_reward=share).starts()
    ends = [s.end_reward(SETTINGS) for s in data.sessions]
    scale = share.factor / (1 - SETTINGS.gamma)
    assert shared - plain == pytest.approx(scale * float(np.mean(ends)), rel=0.05)
