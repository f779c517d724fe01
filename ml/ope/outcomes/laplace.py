"""Penalised regression with a link, for many designs and variances of its levels at once: Fisher scoring and Laplace's approximation.

Every outcome is a mean over weighted parts of a session: minutes, or one part where the outcome is of the session. The mean is mu = sum_m
w_m g(eta_m), eta_m = x_m theta, with a Gaussian prior of theta. Three families:

    gaussian   y ~ N(eta, s^2)
    rounded    y = round(eta + N(0, s^2)), cut to [low, high]: an ordinal regression with equally spaced limits
    binomial   n y of n minutes, p = mean of logistic(eta_m); overdispersed by a factor (McCullagh and Nelder 1989, section 4.5)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, ndtr

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Kind = Literal["gaussian", "rounded", "binomial"]

ROUNDS: Final = 25
RATING_LOW, RATING_HIGH = 1, 10

PRIOR_SESSIONS: Final = 3.0
"""Sessions that the prior of the dispersion counts for."""

DISPERSION: Final = {"gaussian": 0.15**2, "rounded": 0.6**2, "binomial": 2.5}
"""Its prior value: variances of a measured number (Hz^2) and of a rounded one, and a binomial's factor."""


@dataclass(frozen=True)
class Problem:
    """K regressions of the same n sessions.

    Attributes:
        kind: family. design: [K, n, M, q]. parts: w, [n, M], sums to 1. y: [n]; a share for `binomial`. size: minutes of each session, [n].
        prior_mean: [K, q]. precision: of the prior, [K, q].
    """

    kind: Kind
    design: Floats
    parts: Floats
    y: Floats
    size: Floats
    prior_mean: Floats
    precision: Floats

    def only(self, k: int) -> Problem:
        """Select the k-th of the regressions."""
        part = slice(k, k + 1)
        return replace(self, design=self.design[part], prior_mean=self.prior_mean[part], precision=self.precision[part])


@dataclass(frozen=True)
class Solved:
    """Solutions of K regressions.

    Attributes:
        mode: coefficients, [K, q]. factor: L^-T with L L^T the information, [K, q, q]. dispersion: [K]. degrees: of freedom of it.
        log_evidence: up to a common constant, [K].
    """

    mode: Floats
    factor: Floats
    dispersion: Floats
    degrees: Floats
    log_evidence: Floats

    def left_out(self, p: Problem, at: Floats, groups: Sequence[Indices], extra: Floats, weights: Floats | None = None) -> Floats:
        """Predict the expected outcome of every session from the sessions of the other groups, [n].

        One Newton step from the mode of all. Dispersions are those of all.

        Args:
            p: what was solved. at: design to predict from, shape of `p.design`.
            groups: indices of the sessions that are held out together; each session is in one group.
            extra: variance of the predictor of a session whose group is held out, in addition to that of its noise, [K].
            weights: of the regressions, [K]; by default by the evidence of what is left.
        """
        group, surprise = np.zeros(len(p.y), dtype=np.int64), np.zeros((len(self.mode), len(groups)))
        for g, members in enumerate(groups):
            group[members] = g
        each = np.zeros((len(self.mode), len(p.y)))
        for k in range(len(self.mode)):
            theta, surprise[k] = self._leave_group_out(p.only(k), k, _pad(groups))
            eta = np.einsum("nmq,nq->nm", at[k], theta[group])
            each[k] = mean_of(p.kind, eta, p.parts, float(self.dispersion[k]), float(extra[k]))
        left = self.log_evidence[:, None] - surprise
        shares = np.exp(left - left.max(0)) if weights is None else np.tile(weights[:, None], len(groups))
        return np.asarray(np.sum((shares / shares.sum(0))[:, group] * each, axis=0), dtype=np.float64)

    def _leave_group_out(self, one: Problem, k: int, members: Indices) -> tuple[Floats, Floats]:
        """Compute the mode of regression k without each of G groups, [G, q], and the log density of the group given the rest, [G]; members
        [G, m]."""
        mode, dispersion = self.mode[k : k + 1], self.dispersion[k : k + 1]
        jacobian, weight, residual = (v[0] for v in _terms(one, mode, dispersion))
        root, there = np.sqrt(weight), members >= 0
        reach = np.where(there[..., None], (root[:, None] * (jacobian @ self.factor[k]))[members], 0.0)
        away = np.where(there, (residual / root)[members], 0.0)
        # leverages of a group: of a session alone its own; below 1 because of the prior, which a weak one may not show in numbers
        leverage, axes = np.linalg.eigh(reach @ np.swapaxes(reach, 1, 2))
        rest = 1 - np.minimum(leverage, 0.99)
        turned = np.einsum("gmj,gm->gj", axes, away)
        moved = np.einsum("gmq,gmj,gj->gq", reach, axes, turned / rest)
        fit = log_likelihood(one.kind, one.y, one.size, _eta(one, mode), one.parts, dispersion)[0]
        density = np.where(there, fit[members], 0.0).sum(1) + 0.5 * (np.log(rest) - turned**2 * (1 - rest) / rest).sum(1)
        return mode - moved @ self.factor[k].T, density


def _pad(groups: Sequence[Indices]) -> Indices:
    """Pad indices of groups to equal length, [G, m]; -1 where a group has fewer."""
    result = np.full((len(groups), max(len(g) for g in groups)), -1, dtype=np.int64)
    for row, members in zip(result, groups, strict=True):
        row[: len(members)] = members
    return result


def solve(p: Problem) -> Solved:
    """Find modes by Fisher scoring with halved steps, and the dispersion by its moments between the steps."""
    theta, dispersion = p.prior_mean.copy(), np.full(len(p.design), DISPERSION[p.kind])
    value = _objective(p, theta, dispersion)
    for _ in range(ROUNDS):
        slope, information = _derivatives(p, theta, dispersion)
        step = np.linalg.solve(information, slope[..., None])[..., 0]
        length = np.ones(len(theta))
        for _ in range(8):
            trial = theta + length[:, None] * step
            found = _objective(p, trial, dispersion)
            worse = found < value - 1e-9
            if not worse.any():
                break
            length = np.where(worse, 0.5 * length, length)
        theta = np.where((found >= value - 1e-9)[:, None], trial, theta)
        moved = float(np.abs(length[:, None] * step).max())
        after = _dispersion(p, theta, dispersion)
        done = moved < 1e-4 and float(np.abs(np.log(after / dispersion)).max()) < 1e-3
        dispersion = after
        value = _objective(p, theta, dispersion)
        if done:
            break
    _, information = _derivatives(p, theta, dispersion)
    lower = np.linalg.cholesky(information)
    inverse = np.linalg.inv(lower)
    log_det = 2 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(1)
    evidence = value + 0.5 * np.log(p.precision).sum(1) - 0.5 * log_det
    used = theta.shape[1] - np.einsum("kij,kij,kj->k", inverse, inverse, p.precision)
    degrees = np.maximum(len(p.y) - used + PRIOR_SESSIONS, 1.0)
    return Solved(theta, np.swapaxes(inverse, 1, 2), dispersion, degrees, evidence)


def mean_of(kind: Kind, eta: Floats, parts: Floats, dispersion: Floats | float, extra: Floats | float = 0.0) -> Floats:
    """Compute the expected outcome [...] from predictors [..., M]; `extra`, a variance of eta, is averaged over (levels of a new day)."""
    if kind == "binomial":
        flat = eta / np.sqrt(1 + np.pi * np.asarray(extra)[..., None] / 8)
        return np.asarray((parts * expit(flat)).sum(-1), dtype=np.float64)
    mean = (parts * eta).sum(-1)
    if kind == "gaussian":
        return np.asarray(mean, dtype=np.float64)
    width = np.sqrt(np.asarray(dispersion) + np.asarray(extra))
    limits = np.arange(RATING_LOW, RATING_HIGH) + 0.5
    above = ndtr((mean[..., None] - limits) / np.asarray(width)[..., None])
    return np.asarray(RATING_LOW + above.sum(-1), dtype=np.float64)


def log_likelihood(kind: Kind, y: Floats, size: Floats, eta: Floats, parts: Floats, dispersion: Floats) -> Floats:
    """Log (quasi-)likelihood of every session, [K, n]; dispersion [K]."""
    s = dispersion[:, None]
    if kind == "gaussian":
        mean = (parts * eta).sum(-1)
        return np.asarray(-0.5 * (np.log(2 * np.pi * s) + (y - mean) ** 2 / s), dtype=np.float64)
    if kind == "rounded":
        return np.log(_interval(y, (parts * eta).sum(-1), np.sqrt(s))[0])
    share = np.clip((parts * expit(eta)).sum(-1), 1e-9, 1 - 1e-9)
    # Less its value at the best p = y, so that sessions without such minutes fit perfectly.
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.where((y > 0) & (y < 1), y * np.log(y) + (1 - y) * np.log1p(-y), 0.0)
    return np.asarray(size / s * (y * np.log(share) + (1 - y) * np.log1p(-share) - best) - 0.5 * np.log(s), dtype=np.float64)


def _interval(y: Floats, mean: Floats, width: Floats) -> tuple[Floats, Floats, Floats]:
    """Compute P(rounds to y), and mean and mean square of (z - mean) / width given that it does."""
    low = np.where(y <= RATING_LOW, -np.inf, (y - 0.5 - mean) / width)
    high = np.where(y >= RATING_HIGH, np.inf, (y + 0.5 - mean) / width)
    low, high = np.clip(low, -30.0, 30.0), np.clip(high, -30.0, 30.0)
    # In the far tail both ends are taken on the side where numbers keep their digits.
    side = np.where(low + high > 0, -1.0, 1.0)
    near, far = np.where(side < 0, -high, low), np.where(side < 0, -low, high)
    chance = np.maximum(ndtr(far) - ndtr(near), 1e-300)
    density = [np.exp(-0.5 * v**2) / np.sqrt(2 * np.pi) for v in (near, far)]
    first = (density[0] - density[1]) / chance
    second = 1 + (near * density[0] - far * density[1]) / chance
    clipped = chance < 1e-200
    first = np.where(clipped, far, first)
    return chance, side * first, np.where(clipped, far**2, second)


def _eta(p: Problem, theta: Floats) -> Floats:
    return np.einsum("knmq,kq->knm", p.design, theta)


def _objective(p: Problem, theta: Floats, dispersion: Floats) -> Floats:
    """Log posterior [K] up to a constant."""
    fit = log_likelihood(p.kind, p.y, p.size, _eta(p, theta), p.parts, dispersion).sum(1)
    # the dispersion has a scaled inverse chi-squared prior
    prior = -0.5 * PRIOR_SESSIONS * (np.log(dispersion) + DISPERSION[p.kind] / dispersion)
    return np.asarray(fit + prior - 0.5 * (p.precision * (theta - p.prior_mean) ** 2).sum(1), dtype=np.float64)


def _terms(p: Problem, theta: Floats, dispersion: Floats) -> tuple[Floats, Floats, Floats]:
    """Compute per session the slope J of its mean (or predictor) [K, n, q], weight w and residual r [K, n]. Score J r, information w J
    J^T."""
    eta, s = _eta(p, theta), dispersion[:, None]
    if p.kind == "binomial":
        each = expit(eta)
        share = np.clip((p.parts * each).sum(-1), 1e-6, 1 - 1e-6)
        jacobian = np.einsum("knm,knmq->knq", p.parts * each * (1 - each), p.design)
        weight = p.size / s / (share * (1 - share))
        return jacobian, weight, weight * (p.y - share)
    mean = (p.parts * eta).sum(-1)
    jacobian = np.einsum("nm,knmq->knq", p.parts, p.design)
    if p.kind == "gaussian":
        weight = np.broadcast_to(1 / s, mean.shape)
        return jacobian, weight, weight * (p.y - mean)
    _, first, second = _interval(p.y, mean, np.sqrt(s))
    # observed information of a rounded normal: 1 - Var(z | y) / s^2
    return jacobian, np.clip(1 - (second - first**2), 1e-3, 1.0) / s, first / np.sqrt(s)


def _derivatives(p: Problem, theta: Floats, dispersion: Floats) -> tuple[Floats, Floats]:
    """Compute slope [K, q] and information [K, q, q] of the log posterior."""
    jacobian, weight, residual = _terms(p, theta, dispersion)
    slope = np.einsum("knq,kn->kq", jacobian, residual) - p.precision * (theta - p.prior_mean)
    information = np.matmul(np.swapaxes(jacobian * weight[..., None], 1, 2), jacobian)
    information += p.precision[:, :, None] * np.eye(theta.shape[1])
    return slope, information


def _dispersion(p: Problem, theta: Floats, dispersion: Floats) -> Floats:
    """Compute the dispersion given the coefficients, [K]: sessions less what the fit has used up, and the prior for `PRIOR_SESSIONS`."""
    eta, s = _eta(p, theta), dispersion[:, None]
    mean = (p.parts * (expit(eta) if p.kind == "binomial" else eta)).sum(-1)
    if p.kind == "binomial":
        # without a floor one such minute where hardly any is expected would count for all others
        floor = 0.5 / p.size
        square = p.size * (p.y - mean) ** 2 / np.maximum(mean * (1 - mean), floor * (1 - floor))
    elif p.kind == "gaussian":
        square = (p.y - mean) ** 2
    else:
        square = s * _interval(p.y, mean, np.sqrt(s))[2]
    _, information = _derivatives(p, theta, dispersion)
    used = theta.shape[1] - np.einsum("kqq,kq->k", np.linalg.inv(information), p.precision)
    total = square.sum(1) + PRIOR_SESSIONS * DISPERSION[p.kind]
    found = total / np.maximum(len(p.y) - used + PRIOR_SESSIONS, 1.0)
    limits = (1.0, float(p.size.max())) if p.kind == "binomial" else (1e-6, np.inf)
    return np.asarray(np.clip(found, *limits), dtype=np.float64)
