"""End-of-session outcomes from summaries of a session, by ridge regression: tens of sessions carry no more than that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.ope.batches import FEWEST_OUTCOMES, outcome_table
from ml.statistics.ridge import leave_one_out_errors, ridge_weights
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

SUMMARIES = ("mean amplitude", "mean squared amplitude", "mean beta", "share of steps at or above the threshold", "mean late amplitude")
LATE_STEPS = 60
"""Steps before the end that the last summary averages: fast symptoms follow the last minutes."""

PENALTIES = tuple(float(v) for v in 10.0 ** np.arange(0.0, 3.5, 0.5))
RANGES = ((-np.inf, np.inf), (0.0, np.inf), (1.0, 10.0), (0.0, 100.0))
"""Possible values of r_end, grasp, rating and tremor."""


def summarise(beta: Floats, amplitude: Floats, xi_beta: float) -> Floats:
    """`SUMMARIES` of sessions, shape [..., 5], from beta and amplitude along the last axis; NaN steps are left out."""
    known = np.isfinite(beta) & np.isfinite(amplitude)

    def mean(values: Floats, mask: NDArray[np.bool_]) -> Floats:
        return np.asarray(np.sum(np.where(mask, values, 0.0), axis=-1) / np.maximum(mask.sum(axis=-1), 1), dtype=np.float64)

    late = known & (np.arange(beta.shape[-1]) >= beta.shape[-1] - LATE_STEPS)
    above = (np.where(known, beta, 0.0) >= xi_beta).astype(np.float64)
    columns = [mean(amplitude, known), mean(amplitude**2, known), mean(beta, known), mean(above, known), mean(amplitude, late)]
    return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class EndModel:
    """Ridge regression of r_end and the QoCs on standardised summaries, one penalty per outcome.

    Attributes:
        weights: [D, 6, 4] (or [6, 4]): intercept and five slopes per outcome; D bootstrap refits.
        centre, spread: of the summaries, [5].
        penalties: chosen by leave-one-session-out error, [4].
        seen: outcomes that enough sessions have.
        skill: 1 - leave-one-out error / variance, [4]; NaN where unseen.
        residual: root mean squared leave-one-out error, [4]; 0 where unseen.
    """

    weights: Floats
    centre: Floats
    spread: Floats
    penalties: Floats
    seen: tuple[bool, ...]
    skill: Floats
    residual: Floats

    def predict(self, summaries: Floats) -> Floats:
        """Outcomes [..., 4] within their possible ranges, for summaries [..., 5] that broadcast against the leading axis of the weights."""
        x = (summaries - self.centre) / self.spread
        x = np.concatenate([np.ones((*x.shape[:-1], 1)), x], axis=-1)
        predicted = np.einsum("...i,...ij->...j", x, self.weights)
        low, high = np.array(RANGES).T
        return np.asarray(np.clip(predicted, low, high), dtype=np.float64)


def fit_end_model(buffer: ReplayBuffer, indices: NDArray[np.int64] | None = None) -> EndModel:
    """Fit to all sessions; with resamples of sessions, [D, n], the weights are those of D refits with the penalties of all sessions."""
    table, x, centre, spread = _design(buffer)
    seen = tuple(bool(np.isfinite(table[:, j]).sum() >= FEWEST_OUTCOMES) for j in range(table.shape[1]))
    n_outcomes = table.shape[1]
    penalties, skill, residual = np.ones(n_outcomes), np.full(n_outcomes, np.nan), np.zeros(n_outcomes)
    for j in range(n_outcomes):
        ok = np.isfinite(table[:, j])
        if seen[j]:
            errors = [float(np.mean(leave_one_out_errors(x[ok], table[ok, j], p) ** 2)) for p in PENALTIES]
            best = int(np.argmin(errors))
            penalties[j], residual[j] = PENALTIES[best], np.sqrt(errors[best])
            variance = float(table[ok, j].var())
            skill[j] = 1 - errors[best] / variance if variance > 0 else 0.0
    rows = [np.arange(len(x))] if indices is None else list(indices)
    weights = np.stack([_weights(x[row], table[row], penalties, table) for row in rows])
    return EndModel(weights[0] if indices is None else weights, centre, spread, penalties, seen, skill, residual)


def _design(buffer: ReplayBuffer) -> tuple[Floats, Floats, Floats, Floats]:
    table = outcome_table(buffer)
    summaries = np.stack([summarise(s.beta, s.amplitude, buffer.settings.xi_beta) for s in buffer.sessions])
    centre, spread = summaries.mean(0), summaries.std(0)
    spread = np.where(spread > 1e-9, spread, 1.0)
    x = np.concatenate([np.ones((len(summaries), 1)), (summaries - centre) / spread], axis=1)
    return table, x, centre, spread


def _weights(x: Floats, table: Floats, penalties: Floats, everything: Floats) -> Floats:
    """Ridge weights [6, 4]; the intercept is not penalised; the mean of all sessions where a resample has none with the outcome."""
    weights = np.zeros((x.shape[1], table.shape[1]))
    for j in range(table.shape[1]):
        ok = np.isfinite(table[:, j])
        if ok.any():
            weights[:, j] = ridge_weights(x[ok], table[ok, j], float(penalties[j]))
        elif np.isfinite(everything[:, j]).any():
            weights[0, j] = np.nanmean(everything[:, j])
    return weights
