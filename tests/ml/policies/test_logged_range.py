from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.policies.logged_range import random_bound, share_below_bound, stays_in_range
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.rl import HeldOutSessions, split_sessions, train
from ml.rl.algorithms.ddpg import DdpgConfig


def test_the_share_below_the_bound_counts_the_buffers_states(buffer):
    middle = float(np.quantile(buffer.transitions().states[:, -1], 0.4))
    steep = ProportionalPolicy(middle, middle + 1e-6)  # 0 where the newest beta is below the quantile, 1 above
    assert random_bound(buffer) == 0.3
    assert share_below_bound(steep, buffer) == pytest.approx(0.4, abs=0.01)
    assert share_below_bound(ConstantPolicy(0.3), buffer) == 0.0
    assert not stays_in_range(steep, buffer)
    assert stays_in_range(ConstantPolicy(0.3), buffer)


def test_the_lowest_of_several_bounds_counts_and_without_a_random_session_nothing_is_claimed(buffer):
    first, *rest = buffer.sessions
    assert random_bound(replace(buffer, sessions=(replace(first, random_bound=0.1), *rest))) == 0.1
    unknown = replace(buffer, sessions=tuple(replace(s, controller="cdbs", random_bound=None) for s in buffer.sessions))
    assert share_below_bound(ConstantPolicy(0.0), unknown) is None
    assert stays_in_range(ConstantPolicy(0.0), unknown)


def test_a_state_that_may_not_be_kept_is_not_kept_for_its_score(buffer):
    learnt, held = split_sessions(buffer, 0.3)
    config = DdpgConfig(hidden=(16, 12), updates=200, batch=16, record_every=50, actor_lr=1e-2)
    seen = []

    def score(policy):
        seen.append(policy)
        return float(len(seen))

    kept = train(learnt, config, held_out=HeldOutSessions(sessions=held, score=score, every=50, eligible=lambda _: len(seen) == 2))
    assert kept.best_update == 100
    assert kept.policy.to_onnx() == seen[1].to_onnx()
    np.testing.assert_array_equal(kept.held_out["score"], [1.0, 2.0, 3.0, 4.0])
    seen.clear()
    last = train(learnt, config, held_out=HeldOutSessions(sessions=held, score=score, every=50, eligible=lambda _: False))
    assert last.best_update is None
    assert last.policy.to_onnx() == seen[-1].to_onnx() == train(learnt, config).policy.to_onnx()
