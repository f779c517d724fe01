"""Importance weights of sessions with sustained draws: one hold is one decision, so it has one ratio, at its first usable step.

A policy that acts within a hold cannot be weighed by it: the draw was made once, and nothing was decided at the steps after. Importance
sampling abstains there by a typed flag; the session's weight is then zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ml.ope.flags import Flag
from ml.trajectories import SessionTrajectory

Floats = NDArray[np.float64]
LogDensity = Callable[[Floats, Floats], Floats]
Abstention = Literal["acts_within_hold", "hold_density_unknown"]


def abstention(session: SessionTrajectory, steps: NDArray[np.int64], target: Floats, bandwidth: float) -> Abstention | None:
    """Explain why a session of sustained draws cannot be weighed for a policy; None where it can, or where every step was a decision.

    Args:
        session: its holds. steps: usable steps, rising, [k]. target: what the policy does there, [k].
        bandwidth: of the kernel around the target: amplitudes closer than this are one and the same decision.
    """
    for own, log_density in _usable_holds(session, steps):
        if log_density is None:
            return "hold_density_unknown"
        if np.ptp(target[own]) > bandwidth:
            return "acts_within_hold"
    return None


def held_log_ratios(session: SessionTrajectory, steps: NDArray[np.int64], target: Floats, log_density_at: LogDensity) -> Floats:
    """Log ratios of the usable steps, [k]: of each hold at its first one, 0 at the others.

    Args:
        session: whose holds all have a density. steps, target: as in `abstention`.
        log_density_at: log density of amplitudes under the target, elementwise.
    """
    result = np.zeros(len(steps))
    for own, log_density in _usable_holds(session, steps):
        if log_density is None:
            raise ValueError(f"session {session.session_id} has a hold of unknown density")
        first = own[:1]
        result[first] = log_density_at(np.clip(session.amplitude[steps[first]], 0, 1), target[first]) - log_density
    return result


def flags(abstained: Iterable[Abstention | None], *, others: bool) -> tuple[Flag, ...]:
    """Flag sessions that were not weighed.

    Args:
        abstained: of every session. others: whether random sessions remain that were weighed.
    """
    reasons = list(abstained)
    acts, unknown = reasons.count("acts_within_hold"), reasons.count("hold_density_unknown")
    found = []
    if acts:
        found.append(Flag.of("acts_within_hold", float(acts), None, "sessions", refuses=True))
    if unknown:
        found.append(Flag.of("hold_density_unknown", float(unknown), None, "sessions", refuses=not others))
    return tuple(found)


def _usable_holds(session: SessionTrajectory, steps: NDArray[np.int64]) -> Iterable[tuple[NDArray[np.int64], float | None]]:
    """Find the places in `steps` of the usable steps of every hold that has one, and its log density."""
    for hold in session.holds:
        own = np.flatnonzero((steps >= hold.start) & (steps < hold.start + hold.steps))
        if own.size:
            yield own, hold.log_density
