"""The participant's Markov decision process: settings, rewards and returns. Source: Gao et al. 2023, sections 4.1 and 5."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.designs import Bound
from ml.outcomes import OUTCOMES
from ml.qoc import Qoc

AMPLITUDE_TOLERANCE = 1e-4
"""A fraction up to 1 + this is 1: milliamperes stored as float32 do not divide back exactly."""


@dataclass(frozen=True, kw_only=True)
class MdpSettings:
    """Constants of one participant's MDP; a change makes a new settings version, never a new meaning of old results.

    Attributes:
        xi_beta: threshold of the beta amplitude, in the unit of the participant's beta trace (no default in the paper).
        window: W, number of beta amplitudes in a state.
        period_s: m, seconds per step.
        r_a: reward while beta is below the threshold.
        r_b: reward while beta is at or above it.
        c1: price of amplitude per step, C1.
        c2, c3, c4: weights C2, C3 and C4 of outcomes in r_end (`ml.outcomes.EndWeight`); 0 drops one.
        gamma: discount per step (ours; the paper gives none).
        lower_bound: B, lowest amplitude fraction of the *random controller*; never bounds a policy (ours).
        tremor_as_fraction: True when tremor enters r_end as 0-1 instead of per cent.

    Raises:
        ValueError: a constant outside its range; the message names it.
    """

    xi_beta: float
    window: int = 10
    period_s: float = 2.0
    r_a: float = 0.0
    r_b: float = -1.0
    c1: float = 0.3
    c2: float = 10.0
    c3: float = 10.0
    c4: float = 10.0
    gamma: float = 0.99
    lower_bound: float = 0.3
    tremor_as_fraction: bool = True

    def __post_init__(self) -> None:
        numbers = {k: v for k, v in asdict(self).items() if k != "tremor_as_fraction"}
        for name, value in numbers.items():
            if not math.isfinite(value):
                raise ValueError(f"{name} must be a finite number, not {value}")
        for name in ("c1", "c2", "c3", "c4"):
            if numbers[name] < 0:
                raise ValueError(f"{name} must be 0 or more, not {numbers[name]}")
        if self.window < 1:
            raise ValueError(f"window must be at least 1 step, not {self.window}")
        if self.period_s <= 0:
            raise ValueError(f"period_s must be positive, not {self.period_s}")
        if not 0 <= self.gamma < 1:
            raise ValueError(f"gamma must lie in [0, 1), not {self.gamma}")
        Bound(self.lower_bound)
        if self.r_a < self.r_b:
            raise ValueError(f"r_a ({self.r_a}) must not be below r_b ({self.r_b}): beta under the threshold is the better state")

    @property
    def bound(self) -> Bound:
        """Lower bound B of random sessions."""
        return Bound(self.lower_bound)

    def to_json(self) -> dict[str, Any]:
        """Return all constants, by name."""
        return asdict(self)


def step_reward(settings: MdpSettings, beta: NDArray[Any], amplitude: NDArray[Any]) -> NDArray[np.float64]:
    """Compute the reward of steps (eq:per_step_reward): r_a or r_b by the threshold, less C1 times the amplitude.

    Args:
        settings: the participant's MDP constants.
        beta: beta amplitude of the same row as the action (the newest element of s_{t+1}), any shape, unit of `xi_beta`.
        amplitude: amplitude fraction a_t, same shape.

    Returns:
        Rewards, same shape. NaN where beta or amplitude is NaN.
    """
    beta = np.asarray(beta, dtype=np.float64)
    amplitude = np.asarray(amplitude, dtype=np.float64)
    base = np.where(beta < settings.xi_beta, settings.r_a, settings.r_b)
    return np.where(np.isnan(beta), np.nan, base) - settings.c1 * amplitude


def end_reward(settings: MdpSettings, qoc: Qoc) -> float | None:
    """Compute the end-of-session reward r_end: the weighted outcomes of `ml.outcomes` (eq:end_of_session_reward).

    Returns:
        The reward, or None when a QoC with a weight above zero is missing: that masks r_end of the session, never the session.
    """
    total = 0.0
    for outcome in OUTCOMES:
        if outcome.end is None or outcome.end.weight(settings) == 0:
            continue
        value = getattr(qoc, outcome.field)
        if value is None:
            return None
        total += outcome.end.weight(settings) * (float(value) / outcome.end.scale(settings))
    return total


def end_rewards(settings: MdpSettings, qocs: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """Compute `end_reward` of many sessions, [n], from their measured outcomes by `Outcome.field`, [n] each."""
    parts = [o.end.weight(settings) * (qocs[o.field] / o.end.scale(settings)) for o in OUTCOMES if o.end is not None and o.field in qocs]
    return np.asarray(sum(parts, np.zeros(())))
