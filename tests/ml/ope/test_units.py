"""Every method gives the same estimates whatever unit beta is measured in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.ope.registry import estimators
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.population import random_controller_buffer
from ml.trajectories import ReplayBuffer

HORIZON_STEPS = 50
METHODS = tuple(estimators(3, demo=True))
NETWORKS = ("dlsm", "dlsm_paper", "dlmm", "dual_dice")


def measured_in(buffer: ReplayBuffer, unit: float) -> ReplayBuffer:
    """Multiply beta and its threshold by a factor."""
    sessions = tuple(replace(s, lead_beta=s.lead_beta * unit, beta=s.beta * unit) for s in buffer.sessions)
    return replace(buffer, settings=replace(buffer.settings, xi_beta=buffer.settings.xi_beta * unit), sessions=sessions)


def estimated(method: str, buffer: ReplayBuffer, unit: float) -> dict[str, list[float]]:
    """Estimate value, interval and predictions of three policies; mean beta in the first unit."""
    xi = buffer.settings.xi_beta
    policies = {"cdbs": ConstantPolicy(1.0), "half": ConstantPolicy(0.5), "eager": ProportionalPolicy(0.7 * xi, 1.1 * xi, 0.4, 2)}
    found = estimators(3, demo=True)[method].fit(buffer).evaluate(policies, HORIZON_STEPS)
    return {
        name: [e.value, e.low, e.high, *(v / unit if key == "mean_beta" else v for key, v in sorted(e.predicted.items()))]
        for name, e in found.items()
    }


@pytest.mark.parametrize("method", [pytest.param(m, marks=pytest.mark.slow if m in NETWORKS else ()) for m in METHODS])
def test_a_unit_of_beta_changes_no_estimate(method: str) -> None:
    buffer = random_controller_buffer("P2", 3, 3, 50, seed=202)
    expected = estimated(method, buffer, 1.0)
    for unit in (1e-12, 1e-6, 1e6):
        found = estimated(method, measured_in(buffer, unit), unit)
        for name, numbers in expected.items():
            # networks amplify the rounding of their inputs
            np.testing.assert_allclose(
                found[name], numbers, rtol=1e-3 if method in NETWORKS else 1e-6, err_msg=f"{name} in units of {unit:g}"
            )
