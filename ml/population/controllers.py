"""Controllers of a session, a policy or a fixed one, and the amplitudes that the device delivers for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ml.designs import Bound
from ml.policies.policy import Policy, start_sessions
from ml.population.participants import ParticipantModel
from ml.population.physiology import brain
from ml.population.physiology.brain import STREAM_CONTROLLER

Floats = NDArray[np.float64]
FixedController = Literal["random", "cdbs", "no_dbs"]
Controller = Policy | FixedController | Floats
"""A policy, a fixed controller, or amplitudes that a design laid out, [T], the same in all sessions of a call."""
_FIXED: Final[dict[str, float]] = {"cdbs": 1.0, "no_dbs": 0.0}


def is_random(controller: Controller) -> bool:
    """Decide whether a controller explores: by draws of its own, or as a design planned."""
    return isinstance(controller, np.ndarray) or (isinstance(controller, str) and controller == "random")


def chooser(controller: Controller, counters: NDArray[np.uint64], bound: Bound) -> Callable[[Floats], Floats]:
    """Make the function that chooses an amplitude at each step, from the beta windows [N, W]."""
    if isinstance(controller, str) and controller == "random":
        return lambda states: bound.amplitudes(np.array([brain.uniform(row, STREAM_CONTROLLER) for row in counters]))
    if isinstance(controller, np.ndarray):
        laid_out = iter(controller)
        return lambda states: np.full(len(states), next(laid_out))
    if isinstance(controller, str):
        if controller not in _FIXED:
            raise ValueError(f"there is no controller {controller!r}; use 'random', 'cdbs', 'no_dbs' or a policy")
        return lambda states: np.full(len(states), _FIXED[controller])
    policy = start_sessions(controller)

    def act(states: Floats) -> Floats:
        asked = np.asarray(policy.act(states.copy()), dtype=np.float64)
        if asked.shape != (len(states),):
            raise ValueError(f"the policy answered with shape {asked.shape} to {len(states)} states; it must give one amplitude for each")
        if not bool(np.all((asked >= -1e-6) & (asked <= 1 + 1e-6))):
            raise ValueError(f"the policy asked for an amplitude fraction outside [0, 1]: {asked.min()} to {asked.max()}")
        return np.clip(asked, 0.0, 1.0)

    return act


def delivery(participant: ParticipantModel, resolution_ma: float | None, bound: Bound) -> Callable[[Floats], Floats]:
    """Make the function from requested to delivered fractions; rounding never goes below a random controller's bound."""
    if resolution_ma is None:
        return lambda asked: asked
    unit = resolution_ma / participant.cdbs_amplitude_ma
    lowest = bound.steps(unit)
    return lambda asked: np.minimum(np.maximum(np.rint(asked / unit), lowest) * unit, 1.0)
