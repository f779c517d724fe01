"""A buffer that several tests of the posterior share."""

from __future__ import annotations

import pytest

from ml.trajectories import ReplayBuffer
from tests.ml.ope.posterior.known_system import KnownSystem


@pytest.fixture(scope="session")
def known_buffer() -> ReplayBuffer:
    """Three visits of a slow answer."""
    return KnownSystem().buffer()
