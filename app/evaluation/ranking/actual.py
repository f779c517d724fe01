"""What sessions really brought, in the terms of the estimates: the same horizon H, the same discount, the same constants of the reward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ml.mdp import MdpSettings
from ml.trajectories import SessionTrajectory

KNOWN_SHARE = 0.7
"""Least share of the discount weight of the H steps that must lie on steps with a known reward."""

QUANTITIES = ("energy", "mean_beta", "grasp_hz", "rating", "tremor_percent")
"""What methods predict beside the return and sessions show: mean a^2, mean beta (participant's unit), grasp, rating, tremor."""


@dataclass(frozen=True)
class Actual:
    """One session's result.

    Attributes:
        step_return: sum over t < H of gamma^t r_t; None where too little of it is known.
        end_reward: r_end; None where a QoC that it needs is missing.
        energy: mean of a^2 over the steps with a known amplitude; None where there is none.
        shown: `QUANTITIES` that the session has, by name.
    """

    step_return: float | None
    end_reward: float | None
    energy: float | None
    shown: dict[str, float] = field(default_factory=dict)

    @property
    def value(self) -> float | None:
        """The return that estimates aim at; None where a part is unknown."""
        return None if self.step_return is None or self.end_reward is None else self.step_return + self.end_reward


def actual(session: SessionTrajectory, settings: MdpSettings, horizon_steps: int) -> Actual:
    """A session's actual return over H steps.

    Steps without a known reward (invalid beta; H beyond the session's end) count as the discounted mean of the known ones, and a session in
    which these hold less than `KNOWN_SHARE` of the discount weight has no step return. Steps beyond H are left out of the return; QoCs,
    energy and beta are of the whole session, whatever H is.
    """
    weights = settings.gamma ** np.arange(horizon_steps)
    rewards = np.full(horizon_steps, np.nan)
    own = session.rewards(settings)[:horizon_steps]
    rewards[: own.size] = own
    known = ~np.isnan(rewards)
    step_return = None
    if weights[known].sum() >= KNOWN_SHARE * weights.sum():
        step_return = float((weights[known] @ rewards[known]) / weights[known].sum() * weights.sum())
    shown = _shown(session)
    return Actual(step_return, session.end_reward(settings), shown.get("energy"), shown)


def _shown(session: SessionTrajectory) -> dict[str, float]:
    amplitude = session.amplitude[~np.isnan(session.amplitude)]
    beta = session.beta[~np.isnan(session.beta)]
    found = {
        "energy": float(np.mean(amplitude**2)) if amplitude.size else None,
        "mean_beta": float(beta.mean()) if beta.size else None,
        "grasp_hz": session.qoc.grasp_hz,
        "rating": session.qoc.rating,
        "tremor_percent": session.qoc.tremor_percent,
    }
    return {name: float(value) for name, value in found.items() if value is not None}


def mean_of(values: Sequence[float | None]) -> float | None:
    """Mean of the known values; None where there is none."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None
