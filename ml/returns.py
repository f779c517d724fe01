"""Return of a session, and gain of one policy over another. One definition of each, for all of betaloop.

Actual return: sum over t < H of gamma^t r_t + r_end. Gaps have one rule. A step without a known reward counts as the discount-weighted mean
of the known ones. Its beta or amplitude is not valid, or H is beyond the session's end. A session whose known steps have less than
`KNOWN_SHARE` of the discount weight has no step return. Other rules are worse. Where r_a = 0, as in the paper, a missing step that counts
as 0 gets the best possible reward, so that gaps look good. Excluding every session with a gap loses nearly all recordings. Without a least
share a few steps would represent a whole session.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.trajectories import SessionTrajectory

Floats = NDArray[np.float64]

KNOWN_SHARE = 0.7
"""Least share of the discount weight of the H steps that must lie on steps with a known reward."""

BOUND = 0.95
"""One-sided level of a lower bound: that of the lower end of a two-sided interval of 90 %."""

FEWEST_DRAWS = 20
"""Aligned draws below which a bound would be the least of them."""


@dataclass(frozen=True)
class ActualReturn:
    """One session's return.

    Attributes:
        step_return: sum over t < H of gamma^t r_t; None where too little of it is known.
        end_reward: r_end; None where a QoC that it needs is missing.
    """

    step_return: float | None
    end_reward: float | None

    @property
    def value(self) -> float | None:
        """The return that estimates aim at; None where a part is unknown."""
        return None if self.step_return is None or self.end_reward is None else self.step_return + self.end_reward


def actual_return(session: SessionTrajectory, settings: MdpSettings, horizon_steps: int) -> ActualReturn:
    """Compute a session's actual return over H steps, under the rule for gaps of this module; steps beyond H are ignored."""
    return ActualReturn(step_return(session.rewards(settings), settings.gamma, horizon_steps), session.end_reward(settings))


def step_return(rewards: Floats, gamma: float, horizon_steps: int) -> float | None:
    """Sum the step rewards [T] over H steps, discounted, NaN where unknown; None where too little of it is known."""
    own = np.full((1, horizon_steps), np.nan)
    own[0, : min(rewards.size, horizon_steps)] = rewards[:horizon_steps]
    found, shares = step_returns(np.nan_to_num(own), ~np.isnan(own), gamma)
    return float(found[0]) if shares[0] >= KNOWN_SHARE else None


def step_returns(rewards: Floats, known: NDArray[np.bool_], gamma: float) -> tuple[Floats, Floats]:
    """Sum the discounted rewards of several sessions; unknown steps count as the mean of the known ones.

    Args:
        rewards: r_t, [N, H]; values at unknown steps do not matter. known: steps that count, [N, H]. gamma: per step.

    Returns:
        The sums, 0 for a session without a known step, and the share of the discount weight that is known, [N] each.
    """
    discount = gamma ** np.arange(rewards.shape[1])
    weight = np.where(known, discount, 0.0).sum(1)
    sums = np.where(known, rewards * discount, 0.0).sum(1) * discount.sum() / np.maximum(weight, 1e-300)
    return np.asarray(sums, dtype=np.float64), np.asarray(weight / discount.sum(), dtype=np.float64)


@dataclass(frozen=True)
class Gain:
    """Estimated return of a policy less that of a reference.

    Attributes:
        value: the difference. low: its one-sided lower bound, the lower end of the two-sided interval of `level`.
        standard_error: of the difference. high: upper end of the interval; infinite where only the bound was kept.
        level: coverage of the two-sided interval.
    """

    value: float
    low: float
    standard_error: float
    high: float = float("inf")
    level: float = 0.9


def gain(draws: Floats, reference: Floats, level: float = BOUND) -> Gain:
    """Compute the gain of one policy over another. Both have draws of the same resampled sessions, so that what both share cancels.

    Args:
        draws, reference: bootstrap draws of both returns by one method, [D]; draw d of both rests on the same resampled sessions.
        level: of the one-sided lower bound.

    Raises:
        ValueError: draws that are not aligned, not finite or too few; a level outside (0, 1).
    """
    if draws.shape != reference.shape or draws.ndim != 1 or draws.size < FEWEST_DRAWS:
        raise ValueError(
            f"a gain needs {FEWEST_DRAWS} draws or more of both policies, on the same resampled sessions, not {draws.shape} "
            f"and {reference.shape}"
        )
    if not 0 < level < 1:
        raise ValueError(f"the level of a lower bound must be between 0 and 1, not {level}")
    differences = draws - reference
    if not np.isfinite(differences).all():
        raise ValueError("a draw of a return is not finite")
    low, high = np.quantile(differences, [1 - level, level])
    return Gain(float(differences.mean()), float(low), float(differences.std(ddof=1)), float(high), round(2 * level - 1, 12))
