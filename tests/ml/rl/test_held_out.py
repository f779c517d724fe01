from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from ml.mdp import MdpSettings
from ml.rl.algorithms.ddpg import DdpgConfig, train
from ml.rl.held_out import HeldOut, split_sessions
from ml.trajectories import ReplayBuffer

SMALL = DdpgConfig(hidden=(16, 12), updates=200, batch=16, record_every=50, actor_lr=1e-2)


class Rising:
    """A score that is best at the third asking, and remembers which policy that was."""

    def __init__(self, scores):
        self.scores, self.seen = list(scores), []

    def __call__(self, policy):
        self.seen.append(policy.to_onnx())
        return self.scores[len(self.seen) - 1]


def test_sessions_are_held_out_whole_and_from_each_controller(make_buffer):
    buffer = make_buffer(MdpSettings(xi_beta=100.0), count=10)
    kinds = ["random"] * 6 + ["cdbs"] * 4
    buffer = dataclasses.replace(
        buffer, sessions=tuple(dataclasses.replace(s, controller=k) for s, k in zip(buffer.sessions, kinds, strict=True))
    )
    for seed in range(5):
        train_part, held = split_sessions(buffer, 0.3, seed)
        ids = [{s.session_id for s in part.sessions} for part in (train_part, held)]
        assert ids[0] | ids[1] == set(range(10))
        assert not ids[0] & ids[1]
        assert sorted(s.controller for s in held.sessions) == ["cdbs", "random", "random"]
    assert split_sessions(buffer, 0.3, 1)[1].sessions != split_sessions(buffer, 0.3, 2)[1].sessions


def test_one_session_at_least_is_held_out_and_one_kept(make_buffer):
    buffer = make_buffer(MdpSettings(xi_beta=100.0), count=2)
    assert [len(part.sessions) for part in split_sessions(buffer, 0.01)] == [1, 1]
    assert [len(part.sessions) for part in split_sessions(buffer, 0.99)] == [1, 1]
    with pytest.raises(ValueError, match="two sessions or more"):
        split_sessions(ReplayBuffer(buffer.settings, buffer.sessions[:1], "uV", "table"))


def test_the_state_of_the_best_score_comes_back_with_its_update(buffer):
    train_part, held = split_sessions(buffer, 0.3)
    score = Rising([1.0, 2.0, 5.0, 4.0])
    trained = train(train_part, SMALL, held_out=HeldOut(sessions=held, score=score, every=50))
    assert trained.best_update == 150
    assert trained.policy.to_onnx() == score.seen[2] != score.seen[3]
    np.testing.assert_array_equal(trained.held_out["score"], [1.0, 2.0, 5.0, 4.0])
    np.testing.assert_array_equal(trained.held_out["update"], [50, 100, 150, 200])


def test_watching_without_a_score_keeps_the_last_state_and_changes_nothing(buffer):
    train_part, held = split_sessions(buffer, 0.3)
    watched = train(train_part, SMALL, held_out=HeldOut(sessions=held, every=50))
    assert watched.policy.to_onnx() == train(train_part, SMALL).policy.to_onnx()
    assert watched.best_update is None
    assert set(watched.held_out) == {"update", "start_q", "over_logged"}


def test_a_training_without_improvement_stops_early_and_says_so(buffer, tmp_path):
    train_part, held = split_sessions(buffer, 0.3)

    def watch(score):
        return HeldOut(sessions=held, score=score, every=10, patience=3)

    score = Rising([1.0, 3.0, 2.0, 2.5, 2.9, 9.0])
    trained = train(train_part, SMALL, checkpoint=tmp_path / "a", held_out=watch(score))
    assert len(score.seen) == 5
    assert trained.best_update == 20
    assert trained.curve["update"][-1] == 50
    again = train(train_part, SMALL, checkpoint=tmp_path / "a", held_out=watch(score))
    assert len(score.seen) == 5, "a stopped training is not gone on with"
    assert again.policy.to_onnx() == trained.policy.to_onnx()


def test_the_logged_return_goes_on_for_ever_with_the_sessions_mean_reward(make_buffer):
    settings = MdpSettings(xi_beta=100.0, gamma=0.9)
    buffer = make_buffer(settings, count=1, steps=30)
    states, logged = HeldOut(sessions=buffer).starts()
    rewards = buffer.sessions[0].rewards(settings)
    expected, weight = 0.0, 1.0
    for step in range(2000):
        expected += weight * (rewards[step] if step < 30 else rewards.mean())
        weight *= 0.9
    assert logged == pytest.approx(expected)
    np.testing.assert_array_equal(states, buffer.sessions[0].lead_beta[None])


def test_over_estimation_is_q_at_the_first_states_less_the_return(buffer):
    train_part, held = split_sessions(buffer, 0.3)
    watch = HeldOut(sessions=held, score=lambda policy: -50.0, is_step_return=True, every=200)
    trained = train(train_part, SMALL, held_out=watch)
    start_q = trained.held_out["start_q"][-1]
    assert trained.held_out["over_estimate"][-1] == pytest.approx(start_q + 50.0)
    assert trained.held_out["over_logged"][-1] == pytest.approx(start_q - watch.starts()[1])
    scores = trained.policy.normalise(torch.tensor(watch.starts()[0], dtype=torch.float32))
    with torch.no_grad():
        by_hand = trained.critic(scores, trained.policy.act_on_scores(scores)).mean()
    assert start_q == pytest.approx(trained.reward_scale.value(float(by_hand)), rel=1e-5)


def test_impossible_settings_are_refused(buffer):
    with pytest.raises(ValueError, match="share"):
        split_sessions(buffer, 1.0)
    with pytest.raises(ValueError, match="every"):
        HeldOut(sessions=buffer, every=0)
