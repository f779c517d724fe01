from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ml.mdp import end_reward, step_reward
from ml.population.env import ENV_ID, ParticipantEnv


def test_the_environment_obeys_gymnasiums_contract():
    check_env(gymnasium.make(ENV_ID, participant="P3", steps=20).unwrapped, skip_render_check=True)


def test_an_episode_is_one_session_and_its_last_reward_holds_r_end():
    env = ParticipantEnv("P2", steps=12)
    state, info = env.reset(seed=1, options={"hour": 1.0, "visit": 2})
    assert info == {"hour": 1.0, "visit": 2}
    for k in range(12):
        before = state
        state, reward, terminated, truncated, info = env.step(np.array([0.5], dtype=np.float32))
        assert state[:-1] == pytest.approx(before[1:])
        assert state[-1] == pytest.approx(info["beta"], rel=1e-6)
        expected = float(step_reward(env.settings, np.array(info["beta"]), np.array(0.5)))
        assert (terminated, truncated) == (k == 11, False)
        assert reward == pytest.approx(expected + (end_reward(env.settings, info["qoc"]) if terminated else 0))
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.array([0.5]))


def test_the_same_seed_gives_the_same_session_and_another_seed_another():
    def betas(seed):
        env = ParticipantEnv("P1", steps=5, end_reward=False)
        env.reset(seed=seed)
        return [env.step(np.array([0.7]))[4]["beta"] for _ in range(5)]

    assert betas(3) == betas(3)
    assert betas(3) != betas(4)


def test_an_unknown_participant_is_refused():
    with pytest.raises(ValueError, match="P7"):
        ParticipantEnv("P7")
