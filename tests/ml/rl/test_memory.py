"""Critics that remember past amplitudes: against a closed form, and where a window of beta cannot show what a dose does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.rl import ALGORITHMS, HeldOutSessions, TrainedPolicy, train
from ml.rl.memory import SPANS_S, memory_of, remembered
from ml.rl.training import train_on
from ml.trajectories import ReplayBuffer, SessionTrajectory, Transitions

GAMMA = 0.9
WITH_CRITICS = ("ddpg", "td3_bc", "rebrac", "iql")


def session(amplitude: list[float], lead: float | None = None) -> SessionTrajectory:
    steps = len(amplitude)
    beta = np.random.default_rng(steps).uniform(0.5, 1.5, steps)
    return SessionTrajectory(1, 1, "random", np.ones(10), beta, np.array(amplitude), random_bound=0.0, lead_amplitude=lead)


def test_a_held_dose_is_remembered_with_each_span_s_time_constant() -> None:
    held = remembered(session([0.2] * 60, lead=0.8), 2.0)
    k = np.arange(61)[:, None]
    assert np.allclose(held, 2 * (0.2 + 0.6 * np.exp(-2.0 * k / np.array(SPANS_S))) - 1)


def test_a_session_begins_on_clinical_settings_and_unknown_amplitudes_leave_the_memory() -> None:
    found = remembered(session([np.nan, np.nan, 0.0]), 2.0)
    assert np.allclose(found[:3], 1.0)
    assert (found[3] < 1.0).all()


def test_rows_of_transitions_get_the_memory_of_their_own_step() -> None:
    sessions = (session([0.1, 0.9, np.nan, 0.5, 0.4]), replace(session([0.7] * 6, lead=0.3), session_id=2))
    buffer = ReplayBuffer(MdpSettings(xi_beta=1.0), sessions, "uV", "table")
    steps = buffer.transitions()
    now, after = memory_of(buffer, steps)
    for row, (i, k) in enumerate(zip(steps.session, steps.step, strict=True)):
        whole = remembered(sessions[i], buffer.settings.period_s)
        assert np.array_equal(now[row], whole[k])
        assert np.array_equal(after[row], whole[k + 1])


def delayed(count: int = 4000) -> tuple[Transitions, tuple[np.ndarray, np.ndarray]]:
    """Simulate a reward of three times the mean amplitude of the last ten seconds less the amplitude of now; beta is chance.

    A dose of a is worth 3 a - a for ever, so that 1 is best. What pays for it comes later and shows in no window: by the window alone an
    amplitude only costs, and 0 is best.
    """
    rng = np.random.default_rng(3)
    action = rng.uniform(0, 1, count)
    means = remembered(session([*action], lead=0.5), 2.0)
    lately = (means[:-1, 0] + 1) / 2
    beta = rng.uniform(-0.8, 0.8, (count + 1, 2))
    rows = np.arange(count)
    return Transitions(beta[:-1], action, 3 * lately - action, beta[1:], rows, rows * 0), (means[:-1], means[1:])


@pytest.mark.parametrize("remembers", [False, True])
def test_a_dose_that_pays_later_is_taken_by_who_remembers_and_left_by_who_does_not(remembers: bool) -> None:
    transitions, memory = delayed()
    shared = {"batch": 128, "hidden": (48, 48), "updates": 2000, "seed": 1, "critic_lr": 2e-3, "tau": 0.02, "actor_lr": 3e-4}
    config = ALGORITHMS["ddpg"].config(**shared, critic_memory=remembers)
    policy = train_on(transitions, GAMMA, (0.0, 0.46), [config], memory=memory)[0].policy
    chosen = policy.act(transitions.states[:200])
    assert chosen.mean() > 0.9 if remembers else chosen.mean() < 0.1


@pytest.mark.parametrize("name", WITH_CRITICS)
def test_every_algorithm_learns_with_a_memory_and_its_training_is_stored_whole(name: str) -> None:
    rng = np.random.default_rng(0)
    sessions = tuple(replace(session([*rng.uniform(0.3, 1, 40)]), session_id=i) for i in range(3))
    buffer = ReplayBuffer(MdpSettings(xi_beta=1.0), sessions, "uV", "table")
    watch = HeldOutSessions(sessions=buffer, every=5)
    config = ALGORITHMS[name].config(updates=10, batch=8, hidden=(8, 8), critic_memory=True)
    trained = train(buffer, config, held_out=watch)
    assert trained.policy.window == 10, "the policy sees beta alone"
    assert trained.critic.layers[0].in_features == 10 + len(SPANS_S)
    assert np.isfinite(trained.held_out["start_q"]).all()
    again = TrainedPolicy.from_bytes(trained.to_bytes())
    assert np.array_equal(again.policy.act(buffer.transitions().states), trained.policy.act(buffer.transitions().states))
    tuned = train(buffer, replace(config, updates=5), initial=again)
    assert np.isfinite(tuned.curve["critic_loss"]).all()
    with pytest.raises(ValueError, match="remember past amplitudes; set critic_memory"):
        train(buffer, replace(config, updates=5, critic_memory=False), initial=again)


def test_a_memory_that_is_missing_is_asked_for() -> None:
    transitions, _ = delayed(50)
    with pytest.raises(ValueError, match="with the transitions"):
        train_on(transitions, GAMMA, (0.0, 0.46), [ALGORITHMS["ddpg"].config(updates=1, critic_memory=True)])
