from __future__ import annotations

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.trajectories import ReplayBuffer, SessionTrajectory


def random_sessions(settings: MdpSettings, count: int = 4, steps: int = 60, seed: int = 0, noise: float = 0.3) -> ReplayBuffer:
    """Simulate sessions of a random controller on a participant whose beta falls with the amplitude in force."""
    rng = np.random.default_rng(seed)
    sessions = []
    for i in range(count):
        amplitude = rng.uniform(settings.bound, 1, steps)
        beta = 200 * np.exp(noise * rng.standard_normal(steps) - amplitude)
        lead = 120 * np.exp(noise * rng.standard_normal(settings.window))
        sessions.append(SessionTrajectory(i, 1, "random", lead, beta, amplitude, random_bound=settings.bound))
    return ReplayBuffer(settings, tuple(sessions), "uV", "table")


@pytest.fixture(scope="session")
def buffer() -> ReplayBuffer:
    return random_sessions(MdpSettings(xi_beta=100.0))


@pytest.fixture(scope="session")
def make_buffer():
    return random_sessions
