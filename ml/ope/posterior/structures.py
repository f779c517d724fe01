"""The structures that the posterior averages: models of beta in which logged sessions can be replayed under a policy, with draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.ope.impulse.dynamics import ImpulseDynamics, ResponseTable, fit_impulse
from ml.ope.linear.dynamics import Dynamics, SessionTable, fit_dynamics
from ml.ope.linear.estimator import Replayable
from ml.ope.posterior.modes import ModeDynamics, ModeTable, fit_modes
from ml.ope.scale import Scale
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """One structure fitted to a buffer: its sessions' tables and D draws of its coefficients."""

    key: str
    tables: tuple[Any, ...]
    drawn: Replayable

    def thinned(self, draws: int) -> Replayable:
        """The first draws alone, at most those that there are."""
        return take(self.drawn, np.arange(min(draws, len(self.drawn.levels))))


Fitter = Callable[[ReplayBuffer, Scale, int, int, float | None], Fit]
"""Fits a structure: buffer, standardisation, draws, seed, the dose before every session (`ml.ope.lead`)."""


def take(dynamics: Replayable, keep: NDArray[np.int64]) -> Replayable:
    """Some of the draws of a model.

    Raises:
        TypeError: a model of a kind that is not known here.
    """
    if isinstance(dynamics, Dynamics):
        return replace(dynamics, beta=dynamics.beta[keep], levels=dynamics.levels[keep])
    if isinstance(dynamics, ModeDynamics):
        return replace(dynamics, gains=dynamics.gains[keep], levels=dynamics.levels[keep])
    if isinstance(dynamics, ImpulseDynamics):
        return replace(dynamics, gains=dynamics.gains[keep], shapes=dynamics.shapes[keep], levels=dynamics.levels[keep])
    raise TypeError(f"draws of {type(dynamics).__name__} cannot be taken apart")


def fit_linear(buffer: ReplayBuffer, scale: Scale, draws: int, seed: int, before: float | None) -> Fit:
    """The linear model: levels, an answer to the dose over about 20 steps with differences in timing, an autoregression."""
    tables = [SessionTable.of(s, scale, before) for s in buffer.sessions]
    return Fit("linear", tuple(tables), fit_dynamics(buffer, tables, draws, seed, before)[1])


def fit_response(buffer: ReplayBuffer, scale: Scale, draws: int, seed: int, before: float | None) -> Fit:
    """The impulse response with a stable-spline prior behind one of four dose shapes."""
    tables = [ResponseTable.of(s, scale, before) for s in buffer.sessions]
    drawn = fit_impulse(buffer, tables, draws, seed, before)
    # its draws come combination by combination: shuffled, the first few stand for all
    order = np.random.default_rng([seed, 0x0BDE]).permutation(len(drawn.levels))
    return Fit("impulse", tuple(tables), take(drawn, order))


def fit_low_passes(buffer: ReplayBuffer, scale: Scale, draws: int, seed: int, before: float | None) -> Fit:
    """Low-passes of several speeds behind polynomials of the dose."""
    tables = [ModeTable.of(s, scale, before) for s in buffer.sessions]
    return Fit("modes", tuple(tables), fit_modes(buffer, tables, before).drawn(draws, np.random.default_rng([seed, 0x30DE])))


STRUCTURES: dict[str, Fitter] = {"linear": fit_linear, "impulse": fit_response, "modes": fit_low_passes}
"""Every structure by its key."""
