"""The structures that the posterior averages: models of beta in which logged sessions can be replayed under a policy, with draws.

Each is linear in its coefficients given a few hyperparameters, so that a session is held out by taking its sums away (`LinearForm`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.ope.impulse.dynamics import RESPONSE_MODEL, ImpulseDynamics, ResponseTable, fit_impulse, moved, prior_root, response_sums
from ml.ope.linear.dynamics import ANSWERS, LINEAR_MODEL, Dynamics, SessionTable, fit_dynamics, linear_sums, visit_numbers
from ml.ope.linear.estimator import Replayable
from ml.ope.posterior.modes import MODE_MODEL, ModeDynamics, ModeTable, fit_modes, mode_sums
from ml.ope.scale import Scale
from ml.statistics.mixed import MixedModel
from ml.statistics.nested import SessionSums
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LinearForm:
    """A structure at stated hyperparameters as a regression of beta on (1, answers, visits, sessions).

    Attributes:
        weight: share of the evidence among the forms of one structure. model: groups of columns. ratios: lambdas of the groups.
        sums: of every session. answers: columns of every session, [W + T, k] each; levels have no column here.
        phi: autoregression, [W]. noise_weights: of the log of an innovation's scale, [3].
    """

    weight: float
    model: MixedModel
    ratios: Floats
    sums: SessionSums
    answers: tuple[Floats, ...]
    phi: Floats
    noise_weights: Floats


@dataclass(frozen=True)
class Fit:
    """One structure fitted to a buffer: its sessions' tables, D draws of its coefficients, and its forms."""

    key: str
    tables: tuple[Any, ...]
    drawn: Replayable
    forms: tuple[LinearForm, ...]

    def thinned(self, draws: int) -> Replayable:
        """Return the first draws alone, at most those that there are."""
        return take(self.drawn, np.arange(min(draws, len(self.drawn.levels))))


Fitter = Callable[[ReplayBuffer, Scale, int, int, float | None], Fit]
"""Fits a structure: buffer, standardisation, draws, seed, the dose before every session (`ml.ope.lead`)."""

MOST_FORMS = 8
"""Forms of one structure, those of the most evidence, that predict left-out sessions."""


def take(dynamics: Replayable, keep: NDArray[np.int64]) -> Replayable:
    """Return some of the draws of a model.

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
    """Fit the linear model: levels, an answer to the dose over about 20 steps with differences in timing, an autoregression."""
    tables = [SessionTable.of(s, scale, before) for s in buffer.sessions]
    mean, drawn = fit_dynamics(buffer, tables, draws, seed, before)
    sums = linear_sums(tables, visit_numbers(buffer), mean.phi)
    form = LinearForm(1.0, LINEAR_MODEL, mean.ratios, sums, tuple(t.answers for t in tables), mean.phi, mean.noise_weights)
    return Fit("linear", tuple(tables), drawn, (form,))


def no_answer(fit: Fit, buffer: ReplayBuffer) -> Fit:
    """Fit a linear model without any answer to the amplitude, which calls all doses equal: skill is compared with it."""
    tables = [replace(t, answers=np.zeros_like(t.answers)) for t in fit.tables]
    mean, drawn = fit_dynamics(buffer, tables, 1, 0, None)
    zeros = tuple(np.zeros((t.beta.size, ANSWERS)) for t in tables)
    sums = linear_sums(tables, visit_numbers(buffer), mean.phi)
    form = LinearForm(1.0, LINEAR_MODEL, mean.ratios, sums, zeros, mean.phi, mean.noise_weights)
    return Fit("equal", tuple(tables), drawn, (form,))


def fit_response(buffer: ReplayBuffer, scale: Scale, draws: int, seed: int, before: float | None) -> Fit:
    """Fit the impulse response with a stable-spline prior behind one of four dose shapes."""
    tables = [ResponseTable.of(s, scale, before) for s in buffer.sessions]
    drawn = fit_impulse(buffer, tables, draws, seed, before)
    forms, visit = [], visit_numbers(buffer)
    best = sorted(drawn.evidence.items(), key=lambda item: -item[1])[:MOST_FORMS]
    by_shape = {shape: response_sums(tables, visit, drawn.phi, shape) for shape in {shape for (shape, _), _ in best}}
    for (shape, alpha), weight in best:
        answers = tuple(t.means[shape] @ prior_root(alpha) for t in tables)
        sums, ratios = moved(by_shape[shape], alpha), drawn.ratios[shape, alpha]
        forms.append(LinearForm(weight, RESPONSE_MODEL, ratios, sums, answers, drawn.phi, drawn.noise_weights))
    # its draws come combination by combination: shuffled, the first few represent all
    order = np.random.default_rng([seed, 0x0BDE]).permutation(len(drawn.levels))
    return Fit("impulse", tuple(tables), take(drawn, order), tuple(forms))


def fit_low_passes(buffer: ReplayBuffer, scale: Scale, draws: int, seed: int, before: float | None) -> Fit:
    """Fit low-passes of several speeds behind dose functions."""
    tables = [ModeTable.of(s, scale, before) for s in buffer.sessions]
    found = fit_modes(buffer, tables, before)
    sums = mode_sums(tables, found.visit, found.phi)
    columns = tuple(t.columns for t in tables)
    form = LinearForm(1.0, MODE_MODEL, found.fit.likeliest, sums, columns, found.phi, found.noise_weights)
    return Fit("modes", tuple(tables), found.drawn(draws, np.random.default_rng([seed, 0x30DE])), (form,))


STRUCTURES: dict[str, Fitter] = {"linear": fit_linear, "impulse": fit_response, "modes": fit_low_passes}
"""Every structure by its key."""
