"""Behaviour of the logged controllers: their density where it is unknown, and clones of them that can be evaluated like any policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.policies.policy import ConstantPolicy, Policy
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]
Key = tuple[str, int | None]

CONSTANT = 1e-3
"""Amplitudes that spread less than this are one amplitude."""

UNITS = 40
RIDGE = 1e-3
"""Ridge penalty per step of a clone, on standardised features."""


def controller_key(session: SessionTrajectory) -> Key:
    """Identify the controller of a session: its kind and, where one ran, the policy."""
    return session.controller, session.policy_id


def controllers(buffer: ReplayBuffer) -> dict[Key, list[int]]:
    """List the indices of the sessions of every controller with a usable step."""
    groups: dict[Key, list[int]] = {}
    for i, session in enumerate(buffer.sessions):
        if session.usable().any():
            groups.setdefault(controller_key(session), []).append(i)
    return groups


class UniformController:
    """The random controller as a policy: uniform on [lower, 1], a new draw at each call in the order of a seed."""

    def __init__(self, lower: float, seed: int) -> None:
        self._lower, self._rng = lower, np.random.default_rng(seed)

    def act(self, states: NDArray[Any]) -> Floats:
        return self._rng.uniform(self._lower, 1.0, len(states))


@dataclass(frozen=True)
class Clone:
    """Regression of a controller's amplitude on the window: polynomial terms and random tanh units.

    Attributes:
        mean, std: of the window's beta. inner, offset: of the units. centre, spread: of the features. weights: of the regression.
        residual: standard deviation of the logged amplitudes around it.
    """

    mean: float
    std: float
    inner: Floats
    offset: Floats
    centre: Floats
    spread: Floats
    weights: Floats
    residual: float

    def act(self, states: NDArray[Any]) -> Floats:
        """Compute cloned amplitudes within [0, 1]."""
        x = (_features((states - self.mean) / self.std, self.inner, self.offset) - self.centre) / self.spread
        return np.asarray(np.clip(self.weights[0] + x @ self.weights[1:], 0.0, 1.0), dtype=np.float64)


def clone(states: Floats, actions: Floats, seed: int = 0) -> tuple[Policy, float]:
    """Fit a policy that does what was logged, and the spread of the logged amplitudes around it.

    Args:
        states: windows, [N, W]. actions: amplitudes, [N].
    """
    if float(actions.std()) < CONSTANT:
        return ConstantPolicy(float(actions.mean())), 0.0
    rng = np.random.default_rng([seed, 0xC10E])
    mean, std = float(states.mean()), float(states.std()) or 1.0
    inner, offset = rng.normal(size=(3, UNITS)), rng.uniform(-2, 2, UNITS)
    raw = _features((states - mean) / std, inner, offset)
    centre, spread = raw.mean(0), np.maximum(raw.std(0), 1e-6)
    x = np.concatenate([np.ones((len(raw), 1)), (raw - centre) / spread], axis=1)
    ridge = np.full(x.shape[1], RIDGE * len(x))
    ridge[0] = 0.0
    weights = np.linalg.solve(x.T @ x + np.diag(ridge), x.T @ actions)
    cloned = Clone(mean, std, inner, offset, centre, spread, weights, float((actions - np.clip(x @ weights, 0, 1)).std()))
    return cloned, cloned.residual


def clones(buffer: ReplayBuffer, seed: int = 0) -> dict[Key, tuple[Policy, float]]:
    """Make a substitute for every controller of a buffer: uniform for sessions drawn at every step, else a clone, with its residual
    spread."""
    result: dict[Key, tuple[Policy, float]] = {}
    for key, indices in controllers(buffer).items():
        bounds = [buffer.sessions[i].uniform_bound for i in indices]
        known = [b for b in bounds if b is not None]
        if known:
            lower = float(np.mean(known))
            result[key] = UniformController(lower, seed), (1 - lower) / np.sqrt(12)
            continue
        rows = [(s.states()[:-1][s.usable()], s.amplitude[s.usable()]) for s in (buffer.sessions[i] for i in indices)]
        states, actions = np.concatenate([r[0] for r in rows]), np.clip(np.concatenate([r[1] for r in rows]), 0.0, 1.0)
        result[key] = clone(states, actions, seed)
    return result


def rule_of_thumb_bandwidth(buffer: ReplayBuffer) -> float:
    """Apply Silverman's rule for the kernel around a deterministic target, with sessions as the sample size: 1.06 sd(a) n^(-1/5).

    A weight is a product over a session, so sessions are what there are n of. Kept within [0.03, 0.3].
    """
    actions = buffer.transitions().actions
    n = sum(bool(s.usable().any()) for s in buffer.sessions)
    return float(np.clip(1.06 * float(actions.std()) * n ** (-0.2), 0.03, 0.3))


def _features(window: NDArray[Any], inner: Floats, offset: Floats) -> Floats:
    level = np.stack([window[:, -1], window[:, -3:].mean(1), window.mean(1)], axis=1)
    return np.concatenate([window, level[:, :1] ** 2, level[:, 2:] ** 2, np.tanh(level @ inner + offset)], axis=1)
