"""Each step's share of the end-of-session reward, so that a critic may sum what the study values and not beta and energy alone.

The paper leaves QoCs out of training, because one number per session is sparse (Gao et al. 2023, remark 1). Reconstructing step rewards
from an end-of-session one is known from evaluation (off-policy evaluation for human feedback, Gao et al., NeurIPS 2023); here the
reconstruction is a ridge regression of r_end on session means of functions of one step's amplitude and beta, which therefore falls apart
into shares of steps:

    r_end  ~  b + w . mean_t phi(a_t, beta_t),   phi = (a, a^2, beta, beta >= xi)

Each QoC is regressed by itself, because grasp, rating and tremor differ in noise and in what they answer to; the sum of the fits, weighted
by C2 to C4, is the fit of r_end. Sessions of one visit share a day (medication, sleep, mood): each visit has a level of its own, shrunk
towards 0, so that contrasts within a day count for more than a good day that chanced upon a low amplitude. Both penalties are those that
predict left-out sessions best.

A critic sums without end and discounts, so a share enters as (1 - gamma) / (1 - gamma^H) of it, H the median session: steps and r_end
then stand in the same proportion as in the return of eq:ope_total_return.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.statistics.ridge import leave_one_out_errors, ridge_weights
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]

FEWEST_SESSIONS = 8
"""Sessions with an r_end below which no share is learnt: four slopes from fewer say nothing."""

PENALTIES = tuple(float(v) for v in 10.0 ** np.arange(-1.0, 3.5, 0.5))
"""Ridge penalties of the slopes, on standardised session means."""

VISIT_PENALTIES = (0.3, 1.0, 3.0, 10.0, math.inf)
"""Ridge penalties of the visits' levels: variance between sessions of a day over that between days; infinite knows no days."""


@dataclass(frozen=True)
class EndReward:
    """A fitted share.

    Attributes:
        weights: intercept and slopes of standardised functions, summed over the QoCs, [5]. centre, spread: of the session means, [4].
        xi_beta: threshold of beta. factor: (1 - gamma) / (1 - gamma^H).
        skill: 1 - leave-one-session-out error / variance of r_end.
        sessions: with an r_end.
    """

    weights: Floats
    centre: Floats
    spread: Floats
    xi_beta: float
    factor: float
    skill: float
    sessions: int

    def per_step(self, session: SessionTrajectory) -> Floats:
        """What every step adds to its reward, [T]; NaN where amplitude or beta is unknown."""
        x = (_functions(session, self.xi_beta) - self.centre) / self.spread
        return np.asarray(self.factor * (self.weights[0] + x @ self.weights[1:]), dtype=np.float64)


def fit_end_reward(buffer: ReplayBuffer) -> EndReward | None:
    """Learn the share; None where fewer than `FEWEST_SESSIONS` have an r_end or it predicts left-out sessions no better than their mean."""
    settings = buffer.settings
    rows = [(s, end) for s in buffer.sessions if (end := s.end_reward(settings)) is not None and s.usable().any()]
    if settings.c2 + settings.c3 + settings.c4 == 0 or len(rows) < FEWEST_SESSIONS:
        return None
    means = np.stack([np.nanmean(_functions(s, settings.xi_beta), axis=0) for s, _ in rows])
    centre, spread = means.mean(0), means.std(0)
    spread = np.where(spread > 1e-9, spread, 1.0)
    x = np.concatenate([np.ones((len(rows), 1)), (means - centre) / spread], axis=1)
    days = _days([s.visit for s, _ in rows])
    fits = [_fit(x, days, part) for part in _parts([s for s, _ in rows], settings)]
    ends = np.array([end for _, end in rows], dtype=np.float64)
    variance = float(ends.var())
    error = float(np.mean(np.sum([errors for _, errors in fits], axis=0) ** 2))
    skill = 1 - error / variance if variance > 0 else 0.0
    if skill <= 0:
        return None
    factor = (1 - settings.gamma) / (1 - settings.gamma ** buffer.median_steps())
    weights = np.sum([weights for weights, _ in fits], axis=0)
    return EndReward(weights, centre, spread, settings.xi_beta, factor, skill, len(rows))


def _parts(sessions: Sequence[SessionTrajectory], settings: MdpSettings) -> list[Floats]:
    """What each QoC that counts adds to the sessions' r_end, [n] each: r_end with the other weights at 0."""
    alone = (
        replace(settings, c3=0.0, c4=0.0) if settings.c2 > 0 else None,
        replace(settings, c2=0.0, c4=0.0) if settings.c3 > 0 else None,
        replace(settings, c2=0.0, c3=0.0) if settings.c4 > 0 else None,
    )
    return [np.array([s.end_reward(one) for s in sessions], dtype=np.float64) for one in alone if one is not None]


def _days(visits: Sequence[int]) -> Floats:
    """Which visit each session belongs to, [n, V]."""
    return np.asarray(np.asarray(visits)[:, None] == np.unique(visits)[None, :], dtype=np.float64)


def _fit(x: Floats, days: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Intercept and slopes [p] of y [n] on the design [n, p] beside levels of the days [n, V], and the errors [n] of left-out sessions."""
    best: tuple[float, Floats, Floats, float] | None = None
    for penalty, day_penalty in product(PENALTIES, VISIT_PENALTIES):
        # One penalty for all columns: that of a column times c is the penalty over c^2.
        design = np.concatenate([x, days * math.sqrt(penalty / day_penalty)], axis=1)
        errors = leave_one_out_errors(design, y, penalty)
        loss = float(np.mean(errors**2))
        if best is None or loss < best[0]:
            best = (loss, design, errors, penalty)
    assert best is not None
    _, design, errors, penalty = best
    return ridge_weights(design, y, penalty)[: x.shape[1]], errors


def _functions(session: SessionTrajectory, xi_beta: float) -> Floats:
    """phi of every step, [T, 4]; a row is NaN where amplitude or beta is unknown."""
    a, beta = session.amplitude, session.beta
    phi = np.stack([a, a**2, beta, (beta >= xi_beta).astype(np.float64)], axis=1)
    return np.asarray(np.where((np.isfinite(a) & np.isfinite(beta))[:, None], phi, np.nan), dtype=np.float64)
