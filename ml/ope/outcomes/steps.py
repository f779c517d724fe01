"""Share of every step in a session's expected outcomes: the outcome model taken apart into steps.

The model is of sessions and minutes, and is curved. A share of minutes is a logistic, a rating ends at its limits, a dose saturates. A step
adds what its minute has. Beyond that it adds the difference of its own dose and beta from the minute, times the slope there. So the shares
of a session have the mean that the model expects of the session. A dose counts for more in a minute that is about to tremble than in a
quiet one. One noisy beta is not taken for a whole minute.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.ope.outcomes.laplace import mean_of
from ml.ope.outcomes.minutes import Minutes, minute_bounds, step_features
from ml.ope.outcomes.model import COLUMN, EndModel
from ml.ope.outcomes.regressions import KINDS, LEADING, PERCENT, Regression, burden_of
from ml.trajectories import SessionTrajectory

Floats = NDArray[np.float64]

SLOPE_STEP = 1e-3
"""Half the distance over which a slope is taken, in the unit of a predictor."""


def end_reward_by_step(model: EndModel, session: SessionTrajectory, settings: MdpSettings) -> Floats:
    """Compute the r_end that each step accounts for, [T]: their mean over the known steps is what the model expects of the session on a new
    day.

    The dose of the last minutes counts no more than that of others here: a policy knows no clock. NaN where amplitude or beta is unknown.
    """
    known = np.isfinite(session.beta) & np.isfinite(session.amplitude)
    result = np.full(known.size, np.nan)
    if not known.any():
        return result
    beta, amplitude = np.where(known, session.beta, 0.0), np.where(known, session.amplitude, 0.0)
    features = step_features(beta, amplitude, settings.xi_beta)
    minute = np.zeros(known.size, dtype=np.int64)
    for m, (first, last) in enumerate(minute_bounds(known.size, settings.period_s)):
        minute[first:last] = m
    of_minute = np.where(known, minute, -1) == np.arange(minute.max() + 1)[:, None]  # [M, T]
    counts = of_minute.sum(1)
    means = (of_minute @ features) / np.maximum(counts, 1)[:, None]
    whole = Minutes(means, counts / known.sum(), counts / known.sum())
    each = Minutes(features[:, None, :], np.ones((known.size, 1)), np.ones((known.size, 1)))
    outcomes = np.broadcast_to(model.unseen, (known.size, model.unseen.size)).copy()
    lead: Floats | None = None
    for outcome, regression in model.ordered():
        shares = _shares(model, regression, whole, each, minute, known, lead)
        lead = shares if outcome == LEADING else lead
        outcomes[:, COLUMN[outcome]] = PERCENT[outcome] * shares
    result[known] = model.joined(outcomes)[known, 0]
    return result


def _shares(
    model: EndModel,
    r: Regression,
    whole: Minutes,
    each: Minutes,
    minute: NDArray[np.int64],
    known: NDArray[np.bool_],
    lead: Floats | None,
) -> Floats:
    """Compute the shares of one outcome, [T], over the members of its posterior; `lead` [T] are those of the outcome that this one
    follows."""
    of_session, of_steps = (burden_of(m, model.centre, model.spread) for m in (whole, each))
    middle = None if lead is None else np.asarray(lead[known].mean())
    total = np.zeros(known.size)
    for weight, member in zip(r.weights, r.members, strict=True):
        own = r.predictor(member, each, of_steps, lead, None)[0][:, 0]
        parts = r.predictor(member, whole, of_session, middle, None)[0]
        at = parts[minute] if parts.size > 1 else np.broadcast_to(parts, own.shape)
        low, mean, high = (
            mean_of(KINDS[r.outcome], (at + shift)[:, None], np.ones(1), member.dispersion, member.day_variance)
            for shift in (-SLOPE_STEP, 0.0, SLOPE_STEP)
        )
        total += weight * (mean + (high - low) / (2 * SLOPE_STEP) * (own - at))
    return total
