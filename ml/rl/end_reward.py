"""Each step's share of the end-of-session reward, so that a critic may sum what the study values and not beta and energy alone.

The paper leaves QoCs out of training, because one number per session is sparse (Gao et al. 2023, remark 1). Reconstructing step rewards
from an end-of-session one is known from evaluation (off-policy evaluation for human feedback, Gao et al., NeurIPS 2023); here the
reconstruction is a ridge regression of r_end on session means of functions of one step's amplitude and beta, which therefore falls apart
into shares of steps:

    r_end  ~  b + w . mean_t phi(a_t, beta_t),   phi = (a, a^2, beta, beta >= xi)

A critic sums without end and discounts, so a share enters as (1 - gamma) / (1 - gamma^H) of it, H the median session: steps and r_end
then stand in the same proportion as in the return of eq:ope_total_return.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.statistics.ridge import leave_one_out_errors, ridge_weights
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]

FEWEST_SESSIONS = 8
"""Sessions with an r_end below which no share is learnt: four slopes from fewer say nothing."""

PENALTIES = tuple(float(v) for v in 10.0 ** np.arange(-1.0, 3.5, 0.5))


@dataclass(frozen=True)
class EndReward:
    """A fitted share.

    Attributes:
        weights: intercept and slopes of standardised functions, [5]. centre, spread: of the session means, [4].
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
    ends = np.array([end for _, end in rows], dtype=np.float64)
    centre, spread = means.mean(0), means.std(0)
    spread = np.where(spread > 1e-9, spread, 1.0)
    x = np.concatenate([np.ones((len(rows), 1)), (means - centre) / spread], axis=1)
    errors = [float(np.mean(leave_one_out_errors(x, ends, p) ** 2)) for p in PENALTIES]
    best = int(np.argmin(errors))
    variance = float(ends.var())
    skill = 1 - errors[best] / variance if variance > 0 else 0.0
    if skill <= 0:
        return None
    factor = (1 - settings.gamma) / (1 - settings.gamma ** buffer.median_steps())
    return EndReward(ridge_weights(x, ends, PENALTIES[best]), centre, spread, settings.xi_beta, factor, skill, len(rows))


def _functions(session: SessionTrajectory, xi_beta: float) -> Floats:
    """phi of every step, [T, 4]; a row is NaN where amplitude or beta is unknown."""
    a, beta = session.amplitude, session.beta
    phi = np.stack([a, a**2, beta, (beta >= xi_beta).astype(np.float64)], axis=1)
    return np.asarray(np.where((np.isfinite(a) & np.isfinite(beta))[:, None], phi, np.nan), dtype=np.float64)
