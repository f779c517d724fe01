"""Power of further visits, simulated from the posterior of the average effect and of both variances.

The contrast of visit v is normal about the average effect with variance tau^2 + sigma^2 (1/n + 1/m): tau between visits, sigma between
sessions of a visit. More sessions shrink the second part alone; what is left is the floor that only visits lower. The prior of
tau / sigma is the half-Cauchy of scale 1, as in `mixed.py`; those of the effect and of log sigma are flat. Given the ratio everything is in
closed form, so that the posterior is a grid over one number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from ml.statistics.within_visits.contrasts import (
    LEAST_FOR_SKEWNESS,
    Measurements,
    Reason,
    Scale,
    Unavailable,
    VisitContrasts,
    pairs,
    step_of,
    unskewed,
    visit_contrasts,
)

Floats = NDArray[np.float64]
Alternative = Literal["two_sided", "greater"]

RATIOS: Floats = np.exp(np.linspace(np.log(0.02), np.log(50.0), 60))
MOST_VISITS = 12
"""Further visits that are looked at: one a month makes a year."""


@dataclass(frozen=True)
class Posterior:
    """Draws of the average effect and the two standard deviations, each [S], with the contrasts [V] that they came from."""

    effect: Floats
    between: Floats
    within: Floats
    contrasts: VisitContrasts


@dataclass(frozen=True)
class Power:
    """Probability that the test succeeds after more visits, given the data.

    Attributes:
        more_visits: 1 ... K, [K]. power: with the stated sessions in each of them, [K]. limit: with any number of sessions in each, [K]:
            what sessions cannot replace.
        visits_needed: fewest more visits with which `power` reaches the target; None where K are not enough.
        sessions_suffice: whether more sessions in `visits_needed - 1` visits would do as well.
    """

    more_visits: tuple[int, ...]
    power: tuple[float, ...]
    limit: tuple[float, ...]
    visits_needed: int | None
    sessions_suffice: bool


@dataclass(frozen=True)
class Target:
    """Conclusion that further visits are to show.

    Attributes:
        value: the effect that is to be excluded, such as 0, or minus a margin. alternative: that the effect is `greater`, or merely other.
        alpha: level of the test. least_visits: below which there is no test.
    """

    value: float = 0.0
    alternative: Alternative = "two_sided"
    alpha: float = 0.05
    least_visits: int = 2


def posterior(data: Measurements, scale: Scale = "difference", *, draws: int = 1000, seed: int = 0) -> Posterior | Unavailable:
    """Draw the posterior of the average effect, tau and sigma.

    Returns:
        Draws, or why there are none: no visit with both arms, or not one degree of freedom to estimate sigma from.
    """
    contrasts = visit_contrasts(data, scale)
    if isinstance(contrasts, Unavailable):
        return contrasts
    spread = 1 / contrasts.n_tested + 1 / contrasts.n_cdbs
    squares, degrees = _within_squares(data, contrasts, scale)
    total = degrees + contrasts.visits - 1
    if total < 1:
        return Unavailable(Reason.TOO_FEW_SESSIONS)
    d = contrasts.contrast
    precision = 1 / (RATIOS[:, None] ** 2 + spread)
    weight = precision.sum(1)
    mean = precision @ d / weight
    residual = squares + np.sum(precision * (d - mean[:, None]) ** 2, axis=1) + float(contrasts.floor.mean())
    if residual.max() <= 1e-24 * max(1.0, float(np.abs(d).max()) ** 2):
        return Unavailable(Reason.ALL_EQUAL if contrasts.tied else Reason.NO_VARIANCE)
    logs = 0.5 * np.log(precision).sum(1) - 0.5 * np.log(weight) - 0.5 * total * np.log(residual) + np.log(RATIOS / (1 + RATIOS**2))
    chances = np.exp(logs - logs.max())
    rng = np.random.default_rng(seed)
    k = rng.choice(RATIOS.size, draws, p=chances / chances.sum())
    sigma = np.sqrt(residual[k] / np.maximum(rng.chisquare(total, draws), 0.05 * total))
    effect = mean[k] + sigma / np.sqrt(weight[k]) * rng.standard_normal(draws)
    return Posterior(effect, RATIOS[k] * sigma, sigma, contrasts)


def success(of: Posterior, target: Target, sessions_per_arm: float, *, seed: int = 0, most: int = MOST_VISITS) -> NDArray[np.bool_]:
    """Simulate whether the test of `visits.average` succeeds after 1 ... `most` more visits, for every draw of the posterior, [S, most].

    Args:
        of: the posterior. target: what is to be shown. sessions_per_arm: in each further visit; infinity for the floor.
    """
    rng = np.random.default_rng(seed)
    draws = of.effect.size
    sd = np.sqrt(of.between**2 + of.within**2 * 2 / sessions_per_arm)
    new = of.effect[:, None] + sd[:, None] * rng.standard_normal((draws, most))
    seen = np.broadcast_to(of.contrasts.contrast, (draws, of.contrasts.visits))
    values = np.concatenate([seen, new], axis=1)
    count = np.arange(1, values.shape[1] + 1)
    mean = np.cumsum(values, axis=1) / count
    squares = np.maximum(np.cumsum(values**2, axis=1) - count * mean**2, 0.0)
    n = count[of.contrasts.visits :]
    variance = squares[:, -most:] / np.maximum(n - 1, 1)
    floor = max(float(of.contrasts.floor.mean()), 1e-300)
    error = np.sqrt((variance + floor if of.contrasts.null else np.maximum(variance, floor)) / n)
    t = (mean[:, -most:] - target.value) / error
    tail = target.alpha / 2 if target.alternative == "two_sided" else target.alpha
    critical = stdtrit(np.maximum(n - 1, 1), 1 - tail)
    if of.contrasts.bounded:  # the smaller ratio counts, as in the test itself
        third = np.cumsum(values**3, axis=1) / count - 3 * mean * np.cumsum(values**2, axis=1) / count + 2 * mean**3
        skewness = np.where(n >= LEAST_FOR_SKEWNESS, third[:, -most:] / (error * np.sqrt(n)) ** 3, 0.0)
        other = unskewed(t, skewness, n)
        t = np.minimum(np.abs(t), np.abs(other)) if target.alternative == "two_sided" else np.minimum(t, other)
    shown = (np.abs(t) if target.alternative == "two_sided" else t) > critical
    return np.asarray(shown & (n >= max(target.least_visits, 2)), dtype=np.bool_)


def power(
    data: Measurements,
    target: Target,
    *,
    sessions_per_arm: int = 3,
    scale: Scale = "difference",
    wanted: float = 0.8,
    draws: int = 1000,
    seed: int = 0,
) -> Power | Unavailable:
    """Compute the power after each number of further visits, and what more sessions in them could add.

    Raises:
        ValueError: fewer than one session per arm.
    """
    if sessions_per_arm < 1:
        raise ValueError(f"a further visit needs at least one session in either arm, not {sessions_per_arm}")
    found = posterior(data, scale, draws=draws, seed=seed)
    if isinstance(found, Unavailable):
        return found
    reached = success(found, target, sessions_per_arm, seed=seed + 1).mean(0)
    limit = success(found, target, np.inf, seed=seed + 1).mean(0)
    needed = first_reaching(reached, wanted)
    fewer = MOST_VISITS if needed is None else needed - 1
    suffice = fewer >= 1 and bool((limit[:fewer] >= wanted).any())
    return Power(tuple(range(1, MOST_VISITS + 1)), tuple(reached.tolist()), tuple(limit.tolist()), needed, suffice)


def first_reaching(chances: Floats, wanted: float) -> int | None:
    """Find the first of 1 ... K further visits whose probability reaches what is wanted."""
    reached = np.flatnonzero(chances >= wanted)
    return int(reached[0]) + 1 if reached.size else None


def _within_squares(data: Measurements, contrasts: VisitContrasts, scale: Scale) -> tuple[float, int]:
    """Compute the sum of squares within arms of visits, and its degrees of freedom."""
    if scale != "difference":
        # One session adds to a share of pairs the share that it wins alone (DeLong, DeLong and Clarke-Pearson 1988). Where every session
        # wins all pairs, the spread is unknown: one session more, as without a difference (1/12), keeps it above zero.
        won = [pairs(data.value[one], data.value[two], step_of(data, scale)) for _, one, two in data.arms]
        squares = sum(float(np.sum((p.mean(axis) - p.mean()) ** 2)) for p in won for axis in (0, 1))
        return squares + 1 / 12, int(contrasts.n_tested.sum() + contrasts.n_cdbs.sum()) - 2 * len(won) + 1
    arms = [data.value[rows] for _, one, two in data.arms for rows in (one, two)]
    return float(sum(np.sum((a - a.mean()) ** 2) for a in arms)), int(contrasts.n_tested.sum() + contrasts.n_cdbs.sum()) - len(arms)
