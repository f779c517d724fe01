"""Range of the random controller, and policies that leave it: a value below its lower bound B is extrapolation."""

from __future__ import annotations

import numpy as np

from ml.mdp import AMPLITUDE_TOLERANCE
from ml.policies.policy import Policy
from ml.trajectories import ReplayBuffer

LARGEST_SHARE_BELOW = 0.05
"""Largest share of the buffer's states that a policy in the logged range may answer with less than B."""


def random_bound(buffer: ReplayBuffer) -> float | None:
    """Find B of the buffer's random sessions, the lowest where they differ; None where there is no random session."""
    return min((s.random_bound for s in buffer.sessions if s.random_bound is not None), default=None)


def share_below_bound(policy: Policy, buffer: ReplayBuffer) -> float | None:
    """Compute the share of the buffer's usable states that a policy answers with less than B; None where there is no random session."""
    bound = random_bound(buffer)
    if bound is None:
        return None
    return float(np.mean(policy.act(buffer.transitions().states) < bound - AMPLITUDE_TOLERANCE))


def stays_in_range(policy: Policy, buffer: ReplayBuffer) -> bool:
    """Decide whether at most `LARGEST_SHARE_BELOW` of the buffer's states are answered with less than B; True where no B is known."""
    share = share_below_bound(policy, buffer)
    return share is None or share <= LARGEST_SHARE_BELOW
