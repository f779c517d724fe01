"""Flags of a policy in the ranking before a clinician ticks it."""

from __future__ import annotations

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.ope.support.coverage import AmplitudeSupport
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.trajectories import ReplayBuffer, SessionTrajectory


@pytest.fixture
def support() -> AmplitudeSupport:
    rng = np.random.default_rng(0)
    session = SessionTrajectory(1, 1, "random", rng.normal(1, 0.3, 10), rng.normal(1, 0.3, 2000), rng.uniform(0, 1, 2000))
    return AmplitudeSupport(ReplayBuffer(MdpSettings(xi_beta=1.0), (session,), "uV", "table"))


def test_a_policy_that_answers_to_beta_within_the_logged_amplitudes_has_no_flag(support: AmplitudeSupport) -> None:
    assert support.of_policy(ProportionalPolicy(0.5, 1.5, floor=0.3)).flags() == ()


def test_a_constant_policy_is_called_no_closed_loop(support: AmplitudeSupport) -> None:
    flags = support.of_policy(ConstantPolicy(0.6)).flags()
    assert len(flags) == 1
    assert (flags[0].code, flags[0].refuses) == ("no_closed_loop", False)
    assert flags[0].value == pytest.approx(0.6)


def test_a_policy_that_switches_off_is_called_so_with_its_share_of_steps(support: AmplitudeSupport) -> None:
    found = support.of_policy(ProportionalPolicy(1.0, 1.6))
    share = float(np.mean(ProportionalPolicy(1.0, 1.6).act(support.states) < 0.10))
    assert {f.code: f.value for f in found.flags()}["as_good_as_off"] == pytest.approx(share)
    off = support.of_policy(ConstantPolicy(0.0)).flags()
    assert {f.code: f.value for f in off}["as_good_as_off"] == 1.0
