"""One regression per outcome: what it follows, what is known beforehand, and its posterior over dose shapes and levels of days.

    grasp    N( one + dose + late dose + burden + covariates + visit, s^2 )
    rating   round( one + dose + over-stimulation + burden + tremor + covariates + visit + noise ), cut to 1 to 10
    tremor   minutes of n, p = mean over minutes of logistic( one + dose + burden + covariates + visit ), overdispersed

Covariates are the severity of the session and how far medication has worn off, where they are known; no policy moves them.

The dose of a step passes one of `SHAPES` before it is averaged: an effect that saturates is saturated at every moment, not on average.
Priors are weak and say which way effects are expected to go; units are Hz, points of the rating, and logits of a minute.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ml.ope.outcomes.laplace import Kind, Problem, Solved, mean_of, solve
from ml.ope.outcomes.minutes import ABOVE, BETA, DOSE, OVER, SHAPES, Minutes
from ml.outcomes import PREDICTED

Floats = NDArray[np.float64]
Outcome = str
"""A key of `ml.outcomes`."""

Left = Literal["session", "visit"]
"""Parts that are held out in turn: a session, whose visit's others are known, or a visit, as a future day is predicted."""

ORDER: Final[tuple[Outcome, ...]] = ("tremor", "grasp", "rating")
"""In which outcomes are predicted: the rating follows the tremor."""

LEADING: Final = "tremor"
FOLLOWING: Final = "rating"
"""The outcome whose predicted share another one follows, and that other one."""

KINDS: Final[dict[Outcome, Kind]] = {o.key: p.kind for o, p in PREDICTED}
PERCENT: Final[dict[Outcome, float]] = {o.key: p.percent for o, p in PREDICTED}
"""The unit of an outcome in those of its regression: 100 where this has shares of minutes."""

PRIORS: Final[dict[Outcome, dict[str, tuple[float, float]]]] = {
    "grasp": {
        "one": (-0.4, 1.0),
        "dose": (0.6, 0.8),
        "late": (0.3, 0.4),
        "burden": (-0.05, 0.1),
        "severity": (-0.1, 0.2),
        "worn early": (-0.1, 0.2),
        "worn late": (-0.1, 0.2),
    },
    "rating": {
        "one": (-2.0, 3.0),
        "dose": (3.0, 3.0),
        "over": (-0.5, 1.5),
        "burden": (-0.25, 0.35),
        "tremor": (-2.0, 2.0),
        "severity": (-0.3, 0.5),
        "worn early": (-0.3, 0.6),
        "worn late": (-0.3, 0.6),
    },
    "tremor": {
        "one": (-1.0, 6.0),
        "dose": (-5.0, 5.0),
        "burden": (0.25, 0.25),
        "severity": (0.3, 0.5),
        "worn early": (0.4, 0.8),
        "worn late": (0.4, 0.8),
    },
}
"""Mean and standard deviation. `one` of grasp and rating is relative to the mean of the sessions. Dose is the change from no stimulation
to cDBS. Burden and severity change by one standard deviation between sessions, tremor from none to all minutes. The worn ones are the
change when medication has worn off altogether. Chosen on part A of the virtual population, by the error of r_end given true sessions."""

DAYS: Final[dict[Outcome, float]] = {"grasp": 0.15, "rating": 0.5, "tremor": 0.4}
"""Standard deviation of the levels of visits, in the unit of the predictor; `DAY_TIMES` of it are averaged over."""

DAY_TIMES: Final = (0.3, 1.0, 3.0)

WIDER: Final = 1.4
"""Factor on the deviations of drawn coefficients from those of their shape. A dose works differently from visit to visit, and has other
shapes than these: Laplace's approximation has neither. On part A of the virtual population 90 % intervals of differences to cDBS given
true sessions then hold 89 % (paper's design) and 86 % of them; without it 76 and 73 %."""

KEPT: Final = 0.01
"""Members whose weight is less than this share of the largest are dropped."""


@dataclass(frozen=True)
class Sessions:
    """Facts of n sessions besides their steps.

    Attributes:
        visit: index of it, [n]. covariates: by their name in `PRIORS`, [n] each, 0 for a session that is like the mean or not known.
    """

    visit: NDArray[np.int64]
    covariates: Mapping[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True)
class Member:
    """Coefficients of one dose shape: index into `SHAPES`, of the fixed columns [q], levels of the visits [V], dispersion, day variance."""

    shape: int
    fixed: Floats
    levels: Floats
    dispersion: float
    day_variance: float


@dataclass(frozen=True)
class Regression:
    """A fitted outcome.

    Attributes:
        outcome: which. columns: names of the fixed ones. members, weights: of the posterior mean. drawn: draws of the posterior.
        left_out: prediction of each fitted session from others, natural unit (a share for tremor), [n] by what is `Left` out with it.
        sessions: indices of the fitted sessions, [n].
        day_share: posterior mean of the visits' share in what sessions of one shape differ by; on the scale of the predictor.
        shape_evidence: log evidence of each of `SHAPES`, [K], the likeliest 0; the data alone, whatever the prior of shapes.
    """

    outcome: Outcome
    columns: tuple[str, ...]
    members: tuple[Member, ...]
    weights: Floats
    drawn: tuple[Member, ...]
    left_out: Mapping[Left, Floats]
    sessions: NDArray[np.int64]
    day_share: float
    shape_evidence: Floats

    def mean(self, member: Member, minutes: Minutes, burden: Floats, tremor: Floats | None, own: Sessions | None) -> Floats:
        """Predict the outcome [...] of sessions, by one member; arguments as of `predictor`."""
        eta, parts = self.predictor(member, minutes, burden, tremor, own)
        extra = 0.0 if own is not None else member.day_variance
        return mean_of(KINDS[self.outcome], eta, parts, member.dispersion, extra)

    def predictor(
        self, member: Member, minutes: Minutes, burden: Floats, tremor: Floats | None, own: Sessions | None
    ) -> tuple[Floats, Floats]:
        """Compute the predictor of the parts of sessions and the weights of these, [..., M'] each, by one member.

        Args:
            burden: [..., M]. tremor: predicted share of minutes, [...], where the rating follows it.
            own: the sessions, along the last leading axis, whose visit and covariates are to count; without them a new day's.
        """
        covariates = own.covariates if own is not None else {}
        columns, parts = design(self.outcome, member.shape, minutes, burden, tremor, covariates)
        eta = sum((columns[name] * w for name, w in zip(self.columns, member.fixed, strict=True) if name in columns), np.zeros(1))
        if own is not None:
            eta = eta + member.levels[own.visit][:, None]
        return np.broadcast_to(eta, parts.shape), parts


def design(
    outcome: Outcome, shape: int, minutes: Minutes, burden: Floats, tremor: Floats | None, covariates: Mapping[str, Floats]
) -> tuple[dict[str, Floats], Floats]:
    """Compute fixed columns [..., M'] by name and weights of the parts [..., M']; M' is 1 but for tremor, which is of minutes."""
    dose = minutes.features[..., DOSE + shape]
    if outcome == "tremor":
        columns = {"one": np.ones_like(dose), "dose": dose, "burden": burden}
        of_minutes = {name: np.broadcast_to(values[..., None], dose.shape) for name, values in covariates.items()}
        return columns | of_minutes, minutes.share
    mean = (minutes.share * dose).sum(-1)
    whole = {"one": np.ones_like(mean), "dose": mean, "burden": (minutes.share * burden).sum(-1)}
    if outcome == "grasp":
        whole["late"] = (minutes.late * dose).sum(-1) - mean
    else:
        whole["over"] = (minutes.share * minutes.features[..., OVER]).sum(-1)
        if tremor is not None:
            whole["tremor"] = np.broadcast_to(tremor, mean.shape)
    whole |= {name: np.broadcast_to(values, mean.shape) for name, values in covariates.items()}
    return {name: values[..., None] for name, values in whole.items()}, np.ones((*mean.shape, 1))


def burden_of(minutes: Minutes, centre: Floats, spread: Floats) -> Floats:
    """Compute the burden of beta by minute, [..., M]: mean of beta and of the share above the threshold, each in standard deviations of
    sessions."""
    scaled = (minutes.features[..., [BETA, ABOVE]] - centre) / spread
    return np.asarray(scaled.mean(-1), dtype=np.float64)


def fit(
    outcome: Outcome,
    y: Floats,
    minutes: Minutes,
    burden: Floats,
    tremor: Floats | None,
    sessions: Sessions,
    size: Floats,
    draws: int,
    wider: float,
    rng: np.random.Generator,
    tremor_left_out: Floats | None = None,
    shape_prior: Floats | None = None,
) -> Regression:
    """Fit the posterior of one outcome.

    Args:
        y: of every session, [n], NaN where not measured; a share for tremor. tremor: measured shares that the rating follows, [n].
        tremor_left_out: the same as predicted of left-out visits, [n]: a day to come has not shown its tremor either.
        size: minutes of each session, [n]. draws, wider: of the posterior, see `WIDER`.
        shape_prior: log prior of `SHAPES`, [K]; flat where not given.
    """
    known = np.flatnonzero(np.isfinite(y))
    days = np.eye(int(sessions.visit.max()) + 1)[sessions.visit]
    built = [design(outcome, k, minutes, burden, tremor, sessions.covariates) for k in range(len(SHAPES))]
    names = tuple(built[0][0])
    designs = []
    for columns, _ in built:
        fixed = np.stack(list(columns.values()), axis=-1)
        designs.append(np.concatenate([fixed, np.broadcast_to(days[:, None], (*fixed.shape[:2], days.shape[1]))], axis=-1)[known])
    grid = list(product(range(len(SHAPES)), DAY_TIMES))
    mean, deviation = np.array([PRIORS[outcome][name] for name in names]).T
    if outcome != "tremor":
        mean[names.index("one")] += y[known].mean()
    day = np.array([DAYS[outcome] * times for _, times in grid])
    v = days.shape[1]
    problem = Problem(
        KINDS[outcome],
        np.stack([designs[k] for k, _ in grid]),
        built[0][1][known],
        y[known],
        size[known],
        np.tile(np.append(mean, np.zeros(v)), (len(grid), 1)),
        np.concatenate([np.tile(deviation**-2.0, (len(grid), 1)), np.repeat(day[:, None] ** -2.0, v, axis=1)], axis=1),
    )
    found = solve(problem)
    of_shapes = logsumexp(found.log_evidence.reshape(len(SHAPES), len(DAY_TIMES)), axis=1)
    log_posterior = found.log_evidence if shape_prior is None else found.log_evidence + np.repeat(shape_prior, len(DAY_TIMES))
    weights = np.exp(log_posterior - log_posterior.max())
    weights = np.where(weights < KEPT * weights.max(), 0.0, weights)
    weights /= weights.sum()

    def member(k: int, theta: Floats, dispersion: float) -> Member:
        return Member(grid[k][0], theta[: len(names)], theta[len(names) :], dispersion, float(day[k] ** 2))

    kept = np.flatnonzero(weights).tolist()
    members = tuple(member(k, found.mode[k], float(found.dispersion[k])) for k in kept)
    drawn = tuple(member(k, theta, float(found.dispersion[k])) for k, theta in _drawn(found, weights, draws, wider, rng))
    noise = found.dispersion * (np.pi**2 / 3 / np.mean(size) if outcome == "tremor" else 1.0)
    share = float(weights @ (day**2 / (day**2 + noise)))
    at = problem.design
    if tremor_left_out is not None:
        at = at.copy()
        at[..., names.index("tremor")] = tremor_left_out[known, None]
    left = _left_out(replace(found, log_evidence=log_posterior), problem, weights, at, sessions.visit[known], day**2)
    evidence = np.asarray(of_shapes - of_shapes.max(), dtype=np.float64)
    return Regression(outcome, names, members, weights[kept], drawn, left, known, share, evidence)


def _left_out(found: Solved, problem: Problem, weights: Floats, at: Floats, visit: NDArray[np.int64], day: Floats) -> dict[Left, Floats]:
    """Compute `Regression.left_out` of n sessions of the visits [n]; NaN where there is only one visit.

    Args:
        weights: of the regressions, given all, [K]. at: their design with the tremor as predicted of left-out visits. day: variances, [K].
    """
    each = [np.array([i]) for i in range(len(visit))]
    visits = [np.flatnonzero(visit == v) for v in np.unique(visit)]
    by_visit = found.left_out(problem, at, visits, day) if len(visits) > 1 else np.full(len(visit), np.nan)
    return {"session": found.left_out(problem, problem.design, each, 0.0 * day, weights), "visit": by_visit}


def _drawn(found: Solved, weights: Floats, draws: int, wider: float, rng: np.random.Generator) -> list[tuple[int, Floats]]:
    picks = rng.choice(len(weights), draws, p=weights)
    noise = rng.standard_normal((draws, found.mode.shape[1]))
    # The dispersion is not known: draws spread like Student's t.
    degrees = found.degrees[picks]
    reach = wider * np.sqrt(degrees / np.maximum(rng.chisquare(degrees), 0.05 * degrees))
    return [(int(k), found.mode[k] + r * found.factor[k] @ z) for k, r, z in zip(picks, reach, noise, strict=True)]
