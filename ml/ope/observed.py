"""Observed returns of the logged controllers: the reference of every estimate, and of held-out predictions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.ope.behaviour import Key, controllers
from ml.ope.estimate import LEVEL
from ml.ope.flags import DAYS_UNKNOWN, Flag
from ml.returns import actual_return
from ml.statistics.bootstrap import Interval, session_bootstrap
from ml.statistics.mixed import MixedModel, Sums
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]

FEWEST_FOR_INTERVAL = 3


@dataclass(frozen=True)
class Observed:
    """Mean return of one controller's sessions.

    Attributes:
        controller: kind and policy. n: sessions.
        value: mean return over the horizon, by the rule of `ml.returns` for steps that a session lacks.
        step_return: mean of the steps' part. end_reward: mean r_end of the sessions that have one; None where none has.
        standard_error: of `value`, over sessions; None for a single one.
        interval: BCa bootstrap over sessions; None below `FEWEST_FOR_INTERVAL`.
    """

    controller: Key
    n: int
    value: float
    step_return: float
    end_reward: float | None
    standard_error: float | None
    interval: Interval | None


def session_returns(sessions: list[SessionTrajectory], settings: MdpSettings, horizon: int) -> tuple[Floats, Floats]:
    """Compute actual step returns over the horizon and r_end of the sessions that have a step return; r_end is NaN where not measured, [n]
    each."""
    found = [a for a in (actual_return(s, settings, horizon) for s in sessions) if a.step_return is not None]
    ends = [np.nan if a.end_reward is None else a.end_reward for a in found]
    return np.array([a.step_return for a in found], dtype=np.float64), np.array(ends, dtype=np.float64)


def observed(buffer: ReplayBuffer, horizon: int, seed: int = 0) -> dict[Key, Observed]:
    """Summarise every controller of a buffer with a session that has a step return over the horizon."""
    result = {}
    for key, indices in controllers(buffer).items():
        steps, ends = session_returns([buffer.sessions[i] for i in indices], buffer.settings, horizon)
        if not steps.size:
            continue
        known = np.isfinite(ends)
        end = float(ends[known].mean()) if known.any() else None
        # A session without r_end takes the mean of the others, so that it still counts for the steps.
        returns = steps + (np.where(known, ends, end) if end is not None else 0.0)
        n = len(returns)

        def mean(index: NDArray[Any], values: Floats = returns) -> float:
            return float(values[index].mean())

        interval = session_bootstrap(mean, n, level=LEVEL, seed=seed, method="bca") if n >= FEWEST_FOR_INTERVAL else None
        error = float(returns.std(ddof=1) / math.sqrt(n)) if n > 1 else None
        result[key] = Observed(key, n, float(returns.mean()), float(steps.mean()), end, error, interval)
    return result


def day_noise(buffer: ReplayBuffer, horizon: int, draws: int, seed: int) -> tuple[Floats, Flag | None]:
    """Draw what the few visits of a record leave open about the level of returns, [draws], shared by all policies.

    Resampling sessions alone takes the sessions of one day for independent; a bad day lowers them all. Returns less their controller's mean
    are split into days and sessions by one-way analysis of variance. The draws are those of the mean over days, from Student's t with the
    number of visits less one. They widen intervals and cancel between policies.

    Returns:
        The draws, all 0 where days do not differ beyond chance, and a flag where the days cannot be distinguished at all.
    """
    groups = [i for i in controllers(buffer).values() if len({buffer.sessions[k].visit for k in i}) > 1]
    left, visit = [], []
    for indices in groups:
        sessions = [s for s in (buffer.sessions[i] for i in indices) if actual_return(s, buffer.settings, horizon).step_return is not None]
        if len(sessions) < 2:
            continue
        steps, ends = session_returns(sessions, buffer.settings, horizon)
        known = np.isfinite(ends)
        returns = steps + (np.where(known, ends, ends[known].mean()) if known.any() else 0.0)
        left += list(returns - returns.mean())
        visit += [s.visit for s in sessions]
    values, numbers = np.array(left), np.array(visit)
    days = np.unique(numbers)
    if len(days) < 2 or len(values) <= len(days):
        return np.zeros(draws), DAYS_UNKNOWN
    sizes = np.array([(numbers == d).sum() for d in days], dtype=np.float64)
    means = np.array([values[numbers == d].mean() for d in days])
    within = sum(float(np.sum((values[numbers == d] - m) ** 2)) for d, m in zip(days, means, strict=True)) / (len(values) - len(days))
    between = float(np.sum(sizes * (means - values.mean()) ** 2)) / (len(days) - 1)
    effective = (len(values) - float(np.sum(sizes**2)) / len(values)) / (len(days) - 1)
    spread = math.sqrt(max(0.0, (between - within) / effective))
    error = spread * math.sqrt(float(np.sum(sizes**2))) / len(values)
    # Three visits or fewer have a Student's t without a variance; what is drawn is then cut to what can be averaged.
    noise = np.random.default_rng([seed, 0xDA7]).standard_t(max(len(days) - 1, 1), draws)
    return np.asarray(error * np.clip(noise, -6.0, 6.0), dtype=np.float64), None


@dataclass(frozen=True)
class MeanOverDays:
    """Means of returns over sessions of a few days, P policies, n sessions.

    Attributes:
        weights: of the sessions in the mean, [n]; sessions of one visit share a weight, the smaller their own noise the more nearly equal
            the visits'.
        common: draws of the error of the mean that all policies share, [draws]. own: those of each policy's difference from it, [P, draws].
        unknown: what the sessions leave open about days; None where nothing.
    """

    weights: Floats
    common: Floats
    own: Floats
    unknown: Flag | None


def mean_over_days(returns: Floats, visits: NDArray[np.int64], draws: int, seed: int) -> MeanOverDays:
    """Estimate the mean over days of returns [P, n] of the same sessions under several policies: a one-way random effect of the visit.

    With few visits the error follows from the posterior of the visits' variance (`ml.statistics.mixed`), not from a point estimate.
    """
    n = returns.shape[1]
    days = np.unique(visits)
    own = (visits[:, None] == days).astype(np.float64)
    several = 1 < len(days) < n
    design = np.concatenate([np.ones((n, 1)), own if several else np.zeros((n, 0))], axis=1)
    groups = {"visit": tuple(range(1, 1 + len(days)))} if several else {}
    model = MixedModel(design.shape[1], groups, {})
    middle = returns.mean(0)
    shared = model.fit(Sums.of(design, middle))
    weights = np.full(n, 1 / n)
    if several:
        sizes = own.sum(0)
        each = 1 / (shared.ratios[:, :1] + 1 / sizes)  # [K, V]; inverse variances of the visits' means
        weights = own @ ((shared.weights @ (each / each.sum(1, keepdims=True))) / sizes)

    def errors(values: Floats, k: int) -> Floats:
        found = model.fit(Sums.of(design, values)).draws(draws, np.random.default_rng([seed, 0xDA7, k]))[:, 0]
        return np.asarray(found - found.mean(), dtype=np.float64)

    flag = None if several else DAYS_UNKNOWN
    return MeanOverDays(weights, errors(middle, 0), np.stack([errors(r - middle, 1 + i) for i, r in enumerate(returns)]), flag)
