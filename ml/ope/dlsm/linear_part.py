"""Linear prediction of beta one step ahead, to which the heads of a DLSM add what it leaves.

The model is that of `ml.ope.linear.dynamics` (answer to the amplitude, autoregression of order W) at the mean level of the sessions it was
fitted to. The latent state has to find the level of a day or a session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ml.ope.dlsm.batches import Batch
from ml.ope.doses import after_doses, lead_doses
from ml.ope.lead import dose_before
from ml.ope.linear.dynamics import LinearResponse, SessionTable, filtered, fit_dynamics
from ml.ope.scale import Scale
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

BOUND = 8.0
"""Standardised beta of a free run stays within this."""


@dataclass(frozen=True)
class LinearPart:
    """A linear model of standardised beta; n sessions of the buffer.

    Attributes:
        phi: autoregression, lag 1 first, [W]. answer: coefficients of the answers to the amplitude, [7]. level: mean level.
        noise: standard deviation of what it leaves of beta, one step ahead.
        before: dose before each session of the buffer, [n]; NaN: its first amplitude.
    """

    phi: Floats
    answer: Floats
    level: float
    noise: float
    before: Floats

    @classmethod
    def fit(cls, buffer: ReplayBuffer, scale: Scale, learnt: Sequence[int]) -> LinearPart:
        """Fit to the sessions `learnt`, by index; one that is named twice counts twice.

        Raises:
            ValueError: fewer than two of them have usable steps.
        """
        sessions = tuple(buffer.sessions[i] for i in learnt)
        own = replace(buffer, sessions=sessions)
        otherwise = dose_before(own)
        tables = [SessionTable.of(s, scale, otherwise) for s in sessions]
        fitted, _ = fit_dynamics(own, tables, 1, 0, otherwise)
        level = float(fitted.levels[0].mean())
        left = [filtered((t.beta - t.answers @ fitted.beta[0] - level)[:, None], fitted.phi)[t.usable, 0] for t in tables]
        noise = float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
        return cls(fitted.phi, fitted.beta[0], level, max(noise, 1e-6), lead_doses(buffer.sessions, otherwise))

    def response(self, first: Floats, before: Floats) -> LinearResponse:
        """Begin the answer to amplitudes that come step by step, the first of them [P, 1, m], after the doses `before` them, [m]."""
        return LinearResponse(self.answer[None], after_doses(first, before))

    def resting(self, actions: Floats, before: Floats) -> Floats:
        """Compute the level and the answer to which beta returns, [W + T, B], under amplitudes [T, B]: over the window before, then at
        every step."""
        response = self.response(actions[:1, None], before)
        lead = np.repeat(response.lasting()[:, 0], self.phi.size, axis=0)
        return self.level + np.concatenate([lead, *(response.step(a[None, None])[:, 0] for a in actions)])

    def of(self, batch: Batch) -> Batch:
        """Add to the whole buffer's batch `resting`, and with what one-step predictions of beta leave of it, in units of `noise`,
        `left`."""
        rest = self.resting(batch.actions.numpy().astype(np.float64), self.before)
        beta = np.concatenate([batch.states[0].numpy().T, batch.states[1:, :, -1].numpy()]).astype(np.float64)
        windows = np.lib.stride_tricks.sliding_window_view(beta - rest, self.phi.size, axis=0)[:-1]
        predicted = rest[self.phi.size :] + windows @ self.phi[::-1]
        dtype = batch.states.dtype
        left = (beta[self.phi.size :] - predicted) / self.noise
        return replace(batch, resting=torch.as_tensor(rest, dtype=dtype), left=torch.as_tensor(left, dtype=dtype))

    def run(self, lead: Floats, rest: Floats, mean: Floats, std: Floats, noise: Floats) -> Floats:
        """Compute the means of beta given the simulated past, [T, B], where heads say what the linear prediction leaves.

        Args:
            lead: window before the first step, [B, W]. rest: `resting`, [W + T, B].
            mean, std, noise: of what is left, in units of `noise`, and standard normal draws, [T, B].
        """
        w = self.phi.size
        eta = np.concatenate([lead.T - rest[:w], np.empty_like(mean)])
        means = np.empty_like(mean)
        for t in range(len(mean)):
            means[t] = rest[w + t] + self.phi[::-1] @ eta[t : t + w] + self.noise * mean[t]
            # what is simulated stays where data can be: a head that has not learnt yet must not run away
            eta[w + t] = np.clip(means[t] + self.noise * std[t] * noise[t], -BOUND, BOUND) - rest[w + t]
        return means
