"""Interface of a policy to the rest of betaloop: beta windows in, amplitude fractions out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


class Policy(Protocol):
    """A deterministic controller pi(s)."""

    def act(self, states: NDArray[Any]) -> NDArray[np.float64]:
        """Compute amplitude fractions in [0, 1], shape [N], for beta windows in the beta unit of the participant, shape [N, W], oldest
        first."""


@runtime_checkable
class Remembering(Policy, Protocol):
    """A policy that remembers more than its window, such as an amplitude on its way."""

    def begin(self) -> Policy:
        """Start sessions: each call of `act` on what this returns is the next step of the same rows."""


def start_sessions(policy: Policy) -> Policy:
    """Return a policy as it starts sessions that are run step by step; one without a memory is returned as it is."""
    return policy.begin() if isinstance(policy, Remembering) else policy


Score = Callable[[Policy], float]
"""Estimate of a policy's worth, from sessions that the policy did not learn from, say; larger is better."""


class ConstantPolicy:
    """The same amplitude fraction whatever beta does: cDBS at 1, no-DBS at 0."""

    def __init__(self, amplitude: float) -> None:
        if not 0 <= amplitude <= 1:
            raise ValueError(f"an amplitude fraction must be in [0, 1], not {amplitude}")
        self.amplitude = amplitude

    def act(self, states: NDArray[Any]) -> NDArray[np.float64]:
        return np.full(len(states), self.amplitude)


class ProportionalPolicy:
    """Amplitude proportional to the mean of the newest beta amplitudes between two levels, as in proportional adaptive DBS.

    Args:
        low: beta at or below which the amplitude is `floor`.
        high: beta at or above which the amplitude is 1.
        floor: lowest amplitude fraction.
        newest: how many of the newest beta amplitudes are averaged.
    """

    def __init__(self, low: float, high: float, floor: float = 0.0, newest: int = 1) -> None:
        if not low < high:
            raise ValueError(f"low ({low}) must lie below high ({high})")
        if not 0 <= floor <= 1:
            raise ValueError(f"an amplitude fraction must be in [0, 1], not {floor}")
        self.low, self.high, self.floor, self.newest = low, high, floor, newest

    def act(self, states: NDArray[Any]) -> NDArray[np.float64]:
        level = np.asarray(states, dtype=np.float64)[:, -self.newest :].mean(axis=1)
        return self.floor + (1 - self.floor) * np.clip((level - self.low) / (self.high - self.low), 0.0, 1.0)
