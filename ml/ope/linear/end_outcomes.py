"""End-of-session outcomes from summaries of a session, by a mixed model: tens of sessions carry no more than that.

Sessions of one visit share a day, so a visit's level is a random effect: what differs between controllers is read off within visits as far
as days differ. The slope of the mean amplitude has a weak stated prior and is never shrunk by the data; its curvature, the late
amplitude and beta are shrunk as far as the sessions ask for (`ml.statistics.mixed`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ml.ope.scale import FEWEST_OUTCOMES, outcome_table
from ml.statistics.mixed import MixedFit, MixedModel, Sums
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

SUMMARIES = ("mean amplitude", "mean squared amplitude", "mean beta", "share of steps at or above the threshold", "mean late amplitude")
LATE_STEPS = 60
"""Steps before the end that the last summary averages: fast symptoms follow the last minutes."""

DOSE_RATIO = 100.0
"""Prior variance of the change of an outcome from no stimulation to cDBS, in variances of one session: ten of its standard deviations.
Weak where sessions of different mean amplitude are logged; without them it keeps the slope, and says how little is known."""

SEVERITY_RATIO = 1.0
"""Prior variance of what one standard deviation of severity changes, in variances of one session."""

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
    """Outcomes as linear functions of standardised summaries, within their possible ranges.

    r_end is that of the predicted QoCs where every QoC that counts in it can be predicted; else it has a regression of its own.

    Attributes:
        weights: [D, 6, 4] (or [6, 4]): intercept and five slopes per outcome; D draws or refits.
        centre, spread: of the summaries, [5].
        constants: r_end = constants . (grasp, rating, tremor), [3]; None where r_end is predicted by itself.
        seen: outcomes that enough sessions have.
        skill: 1 - leave-one-session-out error / variance, [4]; NaN where unseen.
        residual: root mean squared leave-one-session-out error, [4]; 0 where unseen.
        day_share: share of an outcome's unexplained variance that sessions of one visit have in common, [4]; NaN where unseen.
    """

    weights: Floats
    centre: Floats
    spread: Floats
    constants: Floats | None
    seen: tuple[bool, ...]
    skill: Floats
    residual: Floats
    day_share: Floats

    def predict(self, summaries: Floats) -> Floats:
        """Outcomes [..., 4] within their possible ranges, for summaries [..., 5] that broadcast against the leading axis of the weights."""
        x = (summaries - self.centre) / self.spread
        x = np.concatenate([np.ones((*x.shape[:-1], 1)), x], axis=-1)
        predicted = np.einsum("...i,...ij->...j", x, self.weights)
        low, high = np.array(RANGES).T
        predicted = np.asarray(np.clip(predicted, low, high), dtype=np.float64)
        return self._joined(predicted)

    def with_weights(self, weights: Floats) -> EndModel:
        """The same model with other weights, [..., 6, 4], whose leading axes broadcast against those of the summaries."""
        return replace(self, weights=weights)

    def shifted(self, predicted: Floats, own: Floats) -> Floats:
        """Outcomes [..., 4] with what a session had beyond its prediction added, [..., 4], within their possible ranges."""
        low, high = np.array(RANGES).T
        return self._joined(np.asarray(np.clip(predicted + own, low, high), dtype=np.float64))

    def _joined(self, outcomes: Floats) -> Floats:
        if self.constants is not None:
            outcomes[..., 0] = outcomes[..., 1:] @ self.constants
        return outcomes


def fit_end_model(
    buffer: ReplayBuffer,
    indices: NDArray[np.int64] | None = None,
    draws: int = 0,
    seed: int = 0,
    severity: Floats | None = None,
) -> EndModel:
    """Fit to all sessions.

    A controller that follows beta gives more in a bad hour, so that more stimulation seems to do worse. What it gives depends on beta
    alone: with the level of beta that is not the amplitude's doing beside the amplitude, such sessions compare like with like (the
    back-door criterion of Pearl 1995).

    Args:
        severity: that level of every session, [n], where the caller's model of beta knows it; it is adjusted for and no policy moves it.
        indices: resamples of sessions, [D, n]: the weights are those of D refits, shrunk as the fit to all sessions is.
        draws: D draws of the weights from their posterior instead. seed: theirs.
    """
    design = _design(buffer, severity)
    table, n_outcomes = design.table, design.table.shape[1]
    seen = tuple(bool(np.isfinite(table[:, j]).sum() >= FEWEST_OUTCOMES) for j in range(n_outcomes))
    constants = _constants(buffer, seen)
    rows = [np.arange(len(table))] if indices is None else list(indices)
    weights = np.zeros((draws or len(rows), design.centre.size + 1, n_outcomes))
    skill, residual, day = np.full(n_outcomes, np.nan), np.zeros(n_outcomes), np.full(n_outcomes, np.nan)
    rng = np.random.default_rng([seed, 0xE2D])
    for j in range(n_outcomes):
        known = np.flatnonzero(np.isfinite(table[:, j]))
        if not seen[j]:
            weights[:, 0, j] = table[known, j].mean() if known.size else 0.0
            continue
        fit = design.model.fit(Sums.of(design.columns[known], table[known, j]))
        errors = _left_out(design, fit, known, j)
        variance = float(table[known, j].var())
        residual[j], day[j] = float(np.sqrt(np.mean(errors**2))), fit.share("visit")
        skill[j] = 1 - float(np.mean(errors**2)) / variance if variance > 0 else 0.0
        if draws:
            found = fit.draws(draws, rng)
        elif indices is None:
            found = fit.coefficients[None]
        else:
            found = np.stack([_refit(design, fit, row, j) for row in rows])
        weights[:, :, j] = design.to_summaries(found)
    joint = weights if draws or indices is not None else weights[0]
    return EndModel(joint, design.centre, design.spread, constants, seen, skill, residual, day)


@dataclass(frozen=True)
class _Design:
    """Columns: 1, dose, curvature, late less mean amplitude, burden of beta, severity, visits."""

    table: Floats
    columns: Floats
    model: MixedModel
    centre: Floats
    spread: Floats
    change: Floats

    def to_summaries(self, found: Floats) -> Floats:
        """Weights of 1 and the standardised summaries, [D, 1 + S], from coefficients of the columns [D, q]."""
        slopes = found[:, 1 : 1 + len(self.change)] @ self.change
        # The columns are those of centred summaries, so the constant stays what it is.
        return np.concatenate([found[:, :1], slopes * self.spread], axis=1)


def _design(buffer: ReplayBuffer, severity: Floats | None) -> _Design:
    summaries = np.stack([summarise(s.beta, s.amplitude, buffer.settings.xi_beta) for s in buffer.sessions])
    centre, spread = summaries.mean(0), summaries.std(0)
    spread = np.where(spread > 1e-9, spread, 1.0)
    # dose = mean a; curvature = 4 (mean a^2 - mean a), 0 at both ends of the range; late = late - mean; burden = mean of beta and of
    # the share above the threshold, each in its own spread: two slopes of twins would be large and opposite.
    change = np.array(
        [
            [1.0, 0, 0, 0, 0],
            [-4.0, 4.0, 0, 0, 0],
            [-1.0, 0, 0, 0, 1.0],
            [0, 0, 0.5 / spread[2], 0.5 / spread[3], 0],
        ]
    )
    visits = np.array([s.visit for s in buffer.sessions])
    own = (visits[:, None] == np.unique(visits)).astype(np.float64)
    level = np.zeros(len(summaries)) if severity is None else severity - severity.mean()
    level = level / max(float(level.std()), 1e-9)
    columns = np.concatenate([np.ones((len(summaries), 1)), (summaries - centre) @ change.T, level[:, None], own], axis=1)
    first = 1 + len(change)
    groups = {"shape": (2, 3), "beta": (4,), "visit": tuple(range(first + 1, columns.shape[1]))}
    model = MixedModel(columns.shape[1], groups, {1: DOSE_RATIO, first: SEVERITY_RATIO})
    return _Design(outcome_table(buffer), columns, model, centre, spread, change)


def _constants(buffer: ReplayBuffer, seen: tuple[bool, ...]) -> Floats | None:
    """C2, C3, -C4 (per percent of tremor) where every QoC that counts can be predicted; None where r_end stands alone or is not seen."""
    s = buffer.settings
    constants = np.array([s.c2, s.c3, -s.c4 / (100.0 if s.tremor_as_fraction else 1.0)])
    enough = all(seen[1 + k] for k in range(3) if constants[k] != 0)
    return constants if seen[0] and enough else None


def _refit(design: _Design, fit: MixedFit, row: NDArray[np.int64], j: int) -> Floats:
    """Coefficients of resampled sessions, those of all sessions where a resample has none with the outcome."""
    row = row[np.isfinite(design.table[row, j])]
    if not row.size:
        return fit.coefficients
    return design.model.conditional(Sums.of(design.columns[row], design.table[row, j]), fit.likeliest)


def _left_out(design: _Design, fit: MixedFit, known: NDArray[np.int64], j: int) -> Floats:
    """Prediction errors with each session left out in turn, shrunk as the fit to all; its visit's level is that of the others there."""
    errors = []
    for k in range(known.size):
        rest = np.delete(known, k)
        found = design.model.conditional(Sums.of(design.columns[rest], design.table[rest, j]), fit.likeliest)
        errors.append(design.table[known[k], j] - float(design.columns[known[k]] @ found))
    return np.array(errors)
