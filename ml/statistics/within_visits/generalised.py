"""Generalised linear mixed models of few sessions by Laplace's approximation: ordered categories, and counts out of a number.

theta maximises log likelihood - 1/2 sum_j theta_j^2 / variance_j. Columns of one group share a variance. It maximises the Laplace
approximation of the marginal likelihood times a half-Cauchy density of scale 1 of its root (Tierney and Kadane 1986; Gelman 2006). Both
likelihoods are concave, so that Newton's method finds the one maximum.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, gammaln

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Likelihood = Callable[[Floats], tuple[float, Floats, Floats]]
"""Log likelihood, gradient [q] and information (minus the Hessian) [q, q] at parameters [q]; -inf where they are not allowed."""

ROOTS: Floats = np.array([0.02, 0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 1.6, 2.5, 4.0, 6.5])
"""Standard deviations of a group, in logits, that are tried."""

WEAK = 5.0
"""Standard deviation of the prior of slopes, in logits: keeps a slope finite where one arm is wholly above the other."""

FLAT = 100.0
"""The same of thresholds and intercepts."""


@dataclass(frozen=True)
class GeneralisedFit:
    """Parameters [q] with their covariance [q, q] given the standard deviations of the groups."""

    parameters: Floats
    covariance: Floats
    roots: Mapping[str, float]


def binomial(count: Floats, total: Floats, design: Floats) -> Likelihood:
    """Build the logistic likelihood of `count` out of `total`, [n], for a design [n, q].

    Raises:
        ValueError: a count below zero or above its total.
    """
    if (count < 0).any() or (count > total).any():
        raise ValueError("a count must lie between 0 and its total")
    constant = float(np.sum(gammaln(total + 1) - gammaln(count + 1) - gammaln(total - count + 1)))

    def likelihood(theta: Floats) -> tuple[float, Floats, Floats]:
        eta = design @ theta
        p = expit(eta)
        value = float(np.sum(count * eta - total * np.logaddexp(0.0, eta))) + constant
        return value, design.T @ (count - total * p), (design.T * (total * p * (1 - p))) @ design

    return likelihood


def cumulative(category: Integers, design: Floats) -> Likelihood:
    """Build the proportional-odds likelihood of categories 0 ... K - 1, [n], each of which occurs: logit P(y <= k) = threshold_k - design
    theta.

    The parameters are the K - 1 rising thresholds, then those of the design [n, q] (McCullagh 1980).
    """
    n, steps = category.size, int(category.max())
    upper, lower = np.zeros((n, steps + design.shape[1])), np.zeros((n, steps + design.shape[1]))
    rows = np.arange(n)
    upper[:, steps:] = lower[:, steps:] = -design
    top, bottom = category == steps, category == 0
    upper[rows[~top], category[~top]] = 1.0
    lower[rows[~bottom], category[~bottom] - 1] = 1.0

    def likelihood(theta: Floats) -> tuple[float, Floats, Floats]:
        if (np.diff(theta[:steps]) <= 0).any():
            return -np.inf, theta, np.eye(theta.size)
        f_up, f_low = np.where(top, 1.0, expit(upper @ theta)), np.where(bottom, 0.0, expit(lower @ theta))
        p = np.maximum(f_up - f_low, 1e-300)
        d_up, d_low = f_up * (1 - f_up), f_low * (1 - f_low)
        score = (d_up[:, None] * upper - d_low[:, None] * lower) / p[:, None]
        bend_up, bend_low = d_up * (1 - 2 * f_up) / p, d_low * (1 - 2 * f_low) / p
        information = score.T @ score - (upper.T * bend_up) @ upper + (lower.T * bend_low) @ lower
        return float(np.log(p).sum()), score.sum(0), information

    return likelihood


def fit(likelihood: Likelihood, start: Floats, fixed: Mapping[int, float], groups: Mapping[str, Sequence[int]]) -> GeneralisedFit:
    """Find mode and covariance at the likeliest standard deviations of the groups.

    Args:
        likelihood: of parameters [q]. start: parameters that are allowed, [q].
        fixed: standard deviation of the prior of every column that is in no group.
        groups: columns that share a standard deviation.

    Raises:
        ValueError: a column that is in no group and has no prior.
    """
    covered = set(fixed).union(*map(set, groups.values())) if groups else set(fixed)
    if covered != set(range(start.size)):
        raise ValueError(f"columns {sorted(set(range(start.size)) - covered)} have neither a group nor a prior")
    places = dict.fromkeys(groups, 4)
    best, theta = -np.inf, start
    for turn in range(5):
        before = dict(places)
        for name in groups:
            # First every third root, then those near the best one.
            tried = range(1, ROOTS.size, 3) if turn == 0 else range(max(places[name] - 2, 0), min(places[name] + 3, ROOTS.size))
            for place in tried:
                trial = places | {name: place}
                roots = {g: float(ROOTS[p]) for g, p in trial.items()}
                value, mode, _ = _laplace(likelihood, theta, _precision(start.size, fixed, groups, roots), roots)
                if value > best + 1e-9:
                    best, places, theta = value, trial, mode
        if places == before and turn > 0:
            break
    roots = {g: float(ROOTS[p]) for g, p in places.items()}
    _, theta, information = _laplace(likelihood, theta, _precision(start.size, fixed, groups, roots), roots)
    return GeneralisedFit(theta, np.asarray(np.linalg.inv(information), dtype=np.float64), roots)


def _precision(q: int, fixed: Mapping[int, float], groups: Mapping[str, Sequence[int]], roots: Mapping[str, float]) -> Floats:
    precision = np.zeros(q)
    for column, root in fixed.items():
        precision[column] = root**-2
    for name, columns in groups.items():
        precision[list(columns)] = roots[name] ** -2
    return precision


def _laplace(likelihood: Likelihood, start: Floats, precision: Floats, roots: Mapping[str, float]) -> tuple[float, Floats, Floats]:
    """Log marginal likelihood with the prior of the roots (in their logarithms), mode, and information there."""
    theta = start
    value, gradient, information = likelihood(theta)
    value -= 0.5 * float(precision @ theta**2)
    for _ in range(50):
        bend = information + np.diag(precision)
        step = np.linalg.solve(bend, gradient - precision * theta)
        length = 1.0
        while length > 1e-8:
            trial = theta + length * step
            found, new_gradient, new_information = likelihood(trial)
            found -= 0.5 * float(precision @ trial**2)
            if found >= value - 1e-12:
                break
            length /= 2
        else:
            break
        gain, theta, value, gradient, information = found - value, trial, found, new_gradient, new_information
        if gain < 1e-9:
            break
    bend = information + np.diag(precision)
    prior = sum(float(np.log(r / (1 + r**2))) for r in roots.values())
    log_det = float(np.linalg.slogdet(bend)[1])
    return value + 0.5 * float(np.log(precision).sum()) - 0.5 * log_det + prior, theta, bend
