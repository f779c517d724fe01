"""Held-out free-running prediction."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from ml.ope.dlsm.batches import make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.held_out import BLOCK, FreeRuns, SessionError, block_error, shares
from ml.ope.dlsm.training import MemberTraining
from ml.ope.scale import learn_scale
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer

TINY = DlsmConfig(latent=2, hidden=4, heads=(4,), members=2, steps=10, batch=4, check_every=5, rollouts=12, replay_draws=3)
POLICIES = {"high": ConstantPolicy(0.9), "low": ConstantPolicy(0.4)}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_block_errors_are_those_of_block_means_and_leave_gaps_out():
    seen = np.concatenate([np.full(BLOCK, 1.0), np.full(BLOCK, 3.0)])
    seen[3:8] = np.nan
    exact, constant = seen.copy(), np.full(2 * BLOCK, 2.0)
    exact[np.isnan(exact)] = 100.0
    np.testing.assert_allclose(block_error(seen, np.stack([exact, constant])), [0.0, 1.0])


def test_a_block_of_which_little_is_known_counts_only_where_there_is_no_better_one():
    seen = np.full(2 * BLOCK, np.nan)
    seen[:BLOCK], seen[BLOCK + 1] = 1.0, 50.0
    np.testing.assert_allclose(block_error(seen, np.full((1, 2 * BLOCK), 2.0)), [1.0])
    seen[:BLOCK] = np.nan
    np.testing.assert_allclose(block_error(seen, np.full((1, 2 * BLOCK), 2.0)), [48.0**2])
    assert np.isnan(block_error(np.full(40, np.nan), np.zeros((1, 40)))[0])


def error(session, beta, seen, predicted, outcomes=None):
    return SessionError(session, beta, 0.5 * beta, 2 * beta, 1.0, 1.0, outcomes, None if outcomes is None else 1.0, seen, predicted)


def test_every_group_counts_alike_and_the_reward_by_its_better_source():
    found = shares([[error(0, 0.2, 0, 0)] * 9, [error(1, 0.6, 0, 0)]])
    assert (found.beta, found.head, found.known) == pytest.approx((0.4, 0.2, 0.8))
    assert found.outcomes is None
    assert found.contrast is None
    assert found.score == pytest.approx((0.4 + 0.2) / 2)


def test_the_contrast_sees_the_answer_to_the_action_and_not_the_common_level():
    kinds = {0: "cdbs", 1: "random", 2: "no_dbs"}
    seen = {0: -1.0, 1: 0.0, 2: 1.0}

    def contrast(predict):
        return shares([[error(i, 0.1, seen[i], predict(seen[i])) for i in seen]], kinds).contrast

    assert contrast(lambda v: v + 7.0) == pytest.approx(0.0)
    assert contrast(lambda v: 0.0) == pytest.approx(1.0)
    assert contrast(lambda v: 0.5 * v) == pytest.approx(0.25)
    assert contrast(lambda v: -v) == pytest.approx(4.0)


def test_sessions_left_out_neither_train_a_model_nor_stop_it(small_buffer):
    sessions = list(small_buffer.sessions)
    sessions[4] = replace(sessions[4], beta=sessions[4].beta[::-1].copy(), amplitude=sessions[4].amplitude[::-1].copy())
    scale, learnt = learn_scale(small_buffer), [i for i in range(len(sessions)) if i not in (0, 4, 5)]
    runs = []
    for buffer in (small_buffer, ReplayBuffer(small_buffer.settings, tuple(sessions), "uV", "table")):
        training = MemberTraining(buffer, make_batch(buffer, scale), scale, [0, 5], TINY, 7, "", learnt=learnt)
        member = training.run()
        runs.append((member, training.score(training.batch.select([4]), (4,))))
    assert runs[0][0].course == runs[1][0].course
    assert runs[0][1].score != runs[1][1].score


def test_what_a_check_found_survives_its_way_through_json(small_buffer):
    training = MemberTraining(
        small_buffer, make_batch(small_buffer, learn_scale(small_buffer)), learn_scale(small_buffer), [1], TINY, 0, ""
    )
    training.advance()
    training.check()
    assert FreeRuns.from_json(json.loads(json.dumps(training.best.to_json()))) == training.best
