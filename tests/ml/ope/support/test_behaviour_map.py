"""Amplitudes that policies request at which beta, against policies whose answers are known."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ml.ope.fqe.steps import usable_steps
from ml.ope.support.behaviour_map import COLUMNS, DOSES, BehaviourMap, behaviour_map
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer


class Following:
    """Asks for more amplitude at more beta, in a known line."""

    def act(self, states: np.ndarray) -> np.ndarray:
        return np.clip(states.mean(1) / 200, 0.0, 1.0)


def test_curves_and_cloud_are_those_of_the_recorded_windows(buffer: ReplayBuffer) -> None:
    found = behaviour_map(buffer, {"held": ConstantPolicy(0.55), "following": Following()})
    steps = sum(int(s.usable().sum()) for s in buffer.sessions)
    assert sum(map(sum, found.tried)) == steps
    assert len(found.tried) == COLUMNS
    assert {len(column) for column in found.tried} == {DOSES}
    assert {round(v, 9) for v in found.policies["held"].middle if v is not None} == {0.55}
    curve = found.policies["following"]
    inner = range(1, COLUMNS - 1)  # the outermost columns hold what is beyond them too
    assert sum(curve.middle[k] is not None for k in inner) > 5
    for k in inner:
        if curve.middle[k] is not None:
            least, most = np.clip([found.edges[k] / 200, found.edges[k + 1] / 200], 0, 1)
            assert least - 1e-9 <= curve.low[k] <= curve.middle[k] <= curve.high[k] <= most + 1e-9
    assert BehaviourMap.from_json(json.loads(json.dumps(found.to_json()))) == found


def test_policies_are_as_far_apart_as_their_answers_to_the_recorded_windows(buffer: ReplayBuffer) -> None:
    policies = {"low": ConstantPolicy(0.25), "high": ConstantPolicy(0.75), "following": Following()}
    found = behaviour_map(buffer, policies)
    assert found.distance("low", "high") == found.distance("high", "low") == 0.5
    states = usable_steps(buffer).states
    gaps = [abs(float(Following().act(row[None])[0]) - 0.75) for row in states]
    assert found.distance("following", "high") == pytest.approx(sum(gaps) / len(gaps), abs=1e-4)
    assert found.distance("low", "nobody") is None
    assert BehaviourMap.from_json(found.to_json()).distance("low", "high") == 0.5
