"""What sessions really brought, in the terms of the estimates: the same horizon H, the same discount."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ml.mdp import MdpSettings
from ml.trajectories import SessionTrajectory

KNOWN_SHARE = 0.7
"""Least share of the discount weight of the H steps that must lie on steps with a known reward."""


@dataclass(frozen=True)
class Actual:
    """One session's result.

    Attributes:
        step_return: sum over t < H of gamma^t r_t; None where too little of it is known.
        end_reward: r_end; None where a QoC that it needs is missing.
        energy: mean of a^2 over the steps with a known amplitude; None where there is none.
    """

    step_return: float | None
    end_reward: float | None
    energy: float | None

    @property
    def value(self) -> float | None:
        """The return that estimates aim at; None where a part is unknown."""
        return None if self.step_return is None or self.end_reward is None else self.step_return + self.end_reward


def actual(session: SessionTrajectory, settings: MdpSettings, horizon_steps: int) -> Actual:
    """A session's actual return over H steps.

    Steps without a known reward (invalid beta; H beyond the session's end) count as the discounted mean of the known ones, and a session in
    which these hold less than `KNOWN_SHARE` of the discount weight has no step return. QoCs are of the whole session, whatever H is.
    """
    weights = settings.gamma ** np.arange(horizon_steps)
    rewards = np.full(horizon_steps, np.nan)
    own = session.rewards(settings)[:horizon_steps]
    rewards[: own.size] = own
    known = ~np.isnan(rewards)
    amplitude = session.amplitude[~np.isnan(session.amplitude)]
    step_return = None
    if weights[known].sum() >= KNOWN_SHARE * weights.sum():
        step_return = float((weights[known] @ rewards[known]) / weights[known].sum() * weights.sum())
    return Actual(step_return, session.end_reward(settings), float(np.mean(amplitude**2)) if amplitude.size else None)


def mean_of(values: Sequence[float | None]) -> float | None:
    """Mean of the known values; None where there is none."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None
