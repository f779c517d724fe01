"""How well each structure predicts sessions that it has not learnt from, and the weights that follow from it.

A session that is left out runs freely in a structure that was fitted without it, under its own logged amplitudes, at levels that the other
sessions of its visit suggest and with innovations of other sessions. What counts is what the return is made of: sums of the rewards over
blocks of 30 steps, whose joint density is that of a normal with the runs' means and covariance. Weights follow from the log densities of
sessions by pseudo-BMA with the Bayesian bootstrap (Yao, Vehtari, Simpson and Gelman 2018): a structure that is ahead by the luck of a
few sessions does not take all the weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ml.mdp import step_reward
from ml.ope.fqe.steps import held_amplitude
from ml.ope.linear.dynamics import noise_features
from ml.ope.linear.estimator import Replayable
from ml.ope.posterior.structures import Fit, Fitter
from ml.ope.scale import Scale
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

BLOCK = 30
"""Steps of a block."""
RUNS = 40
"""Free runs behind the density of a left-out session."""
SHRINK = 0.3
"""Share of the runs' covariance that is taken from its diagonal: 40 runs do not tell ten blocks' covariances."""
RESAMPLES = 1000
LEAST_BLOCK_STEPS = 10
FOLDS = 4


@dataclass(frozen=True)
class HeldOut:
    """Predictions of left-out sessions.

    Attributes:
        densities: log density of each session's block sums, structure -> [n]; NaN where a session could not be left out.
        predicted: mean sum of rewards per step of each session, structure -> [n]. observed: the same of what happened, [n].
        weights: of the structures, summing to 1.
    """

    densities: dict[str, Floats]
    predicted: dict[str, Floats]
    observed: Floats
    weights: dict[str, float]


def held_out(buffer: ReplayBuffer, scale: Scale, structures: Mapping[str, Fitter], before: float | None, seed: int) -> HeldOut:
    """Leave groups of sessions out in turn, as evenly over visits and controllers as it goes."""
    n = len(buffer.sessions)
    densities = {key: np.full(n, np.nan) for key in structures}
    predicted = {key: np.full(n, np.nan) for key in structures}
    observed = np.full(n, np.nan)
    seen = [_blocks(_rewards(buffer, i)) for i in range(n)]
    for fold in folds(buffer, FOLDS):
        rest = [k for k in range(n) if k not in set(fold)]
        part = replace(buffer, sessions=tuple(buffer.sessions[k] for k in rest))
        able = [k for k in fold if np.isfinite(seen[k]).any() and np.isfinite(buffer.sessions[k].lead_beta).all()]
        if not able or sum(bool(s.usable().any()) for s in part.sessions) < 2:
            continue
        for key, fitter in structures.items():
            fit = fitter(part, scale, RUNS, seed, before)
            runs = free_runs(fit, part, buffer, able, scale, seed)
            for k, run in zip(able, runs, strict=True):
                known = np.isfinite(seen[k])
                densities[key][k] = _log_density(seen[k][known], _block_sums(run, seen[k].size)[:, known])
                predicted[key][k], observed[k] = _compared(buffer, k, run)
    return HeldOut(densities, predicted, observed, weights_of(densities, seed))


def folds(buffer: ReplayBuffer, number: int) -> list[list[int]]:
    """Indices of sessions in groups: sessions of one controller and visit go to different groups."""
    order = sorted(range(len(buffer.sessions)), key=lambda i: (buffer.sessions[i].controller, buffer.sessions[i].visit, i))
    return [sorted(order[k::number]) for k in range(min(number, len(order)))]


def weights_of(densities: Mapping[str, Floats], seed: int) -> dict[str, float]:
    """Pseudo-BMA weights with the Bayesian bootstrap over sessions; equal ones where nothing could be left out."""
    keys = list(densities)
    table = np.stack([densities[k] for k in keys])
    table = table[:, np.isfinite(table).all(0)]
    if table.shape[1] < 2:
        return dict.fromkeys(keys, 1 / len(keys))
    shares = np.random.default_rng([seed, 0xB0B0]).dirichlet(np.ones(table.shape[1]), RESAMPLES)
    totals = table.shape[1] * shares @ table.T
    each = np.exp(totals - totals.max(1, keepdims=True))
    return dict(zip(keys, (each / each.sum(1, keepdims=True)).mean(0).tolist(), strict=True))


def free_runs(fit: Fit, part: ReplayBuffer, buffer: ReplayBuffer, held: Sequence[int], scale: Scale, seed: int) -> list[Floats]:
    """Rewards of every held session in free runs under its own amplitudes, [RUNS, T] each."""
    rng = np.random.default_rng([seed, 0xF4EE])
    dynamics = fit.drawn
    draws = len(dynamics.levels)
    sessions = [buffer.sessions[k] for k in held]
    steps = max(s.steps for s in sessions)
    amplitudes = np.zeros((len(sessions), steps))
    for row, s in zip(amplitudes, sessions, strict=True):
        row[: s.steps] = held_amplitude(s)
    levels = _levels(dynamics, np.array([s.visit for s in part.sessions]), np.array([s.visit for s in sessions]), rng)
    noise = _noise(dynamics, fit, draws, len(sessions), steps, rng)
    window = scale.beta(np.stack([s.lead_beta for s in sessions]))
    betas = open_loop(dynamics, np.broadcast_to(amplitudes, (draws, *amplitudes.shape)), window, levels, noise, scale)
    rewards = step_reward(buffer.settings, scale.raw_beta(betas), np.broadcast_to(amplitudes, betas.shape))
    return [rewards[:, i, : s.steps] for i, s in enumerate(sessions)]


def open_loop(dynamics: Replayable, amplitudes: Floats, window: Floats, levels: Floats, noise: Floats, scale: Scale) -> Floats:
    """Standardised beta [D, m, T] under amplitudes [D, m, T] from windows [m, W], at levels [D, m], with innovations [D, m, T]."""
    draws, m, steps = amplitudes.shape
    response = dynamics.response(amplitudes[None, :, :, 0], steps)
    low, high = scale.beta(np.array([scale.beta_low, scale.beta_high]))
    reach = 0.25 * (high - low)
    eta = np.empty((draws, m, window.shape[1]))
    found = np.empty((draws, m, steps))
    for t in range(steps):
        rest = response.step(amplitudes[None, :, :, t])[0] + levels
        if t == 0:
            eta[:] = window - rest[..., None]
        predicted = rest + eta @ dynamics.phi[::-1]
        size = np.exp(noise_features(amplitudes[:, :, t], predicted) @ dynamics.noise_weights)
        newest = np.clip(predicted + size * noise[:, :, t], low - reach, high + reach)
        eta = np.concatenate([eta[..., 1:], (newest - rest)[..., None]], axis=-1)
        found[:, :, t] = newest
    return found


def _levels(dynamics: Replayable, visits: NDArray[np.int64], held: NDArray[np.int64], rng: np.random.Generator) -> Floats:
    """Levels of held sessions [D, m]: the mean of their visit's others and a session's deviation from its visit's mean."""
    levels = dynamics.levels
    means = np.stack([levels[:, visits == v].mean(1) for v in visits], axis=1)
    deviation = levels - means
    own = np.stack([levels[:, visits == v].mean(1) if np.any(visits == v) else levels.mean(1) for v in held], axis=1)
    several = np.array([np.sum(visits == v) > 1 for v in visits])
    source = deviation[:, several] if several.any() else deviation
    picked = rng.integers(source.shape[1], size=own.shape)
    return np.asarray(own + np.take_along_axis(source, picked, axis=1))


def _noise(dynamics: Replayable, fit: Fit, draws: int, m: int, steps: int, rng: np.random.Generator) -> Floats:
    """Innovations [D, m, T]: runs of those of sessions drawn at random, in their order."""
    found = [f[:, np.isfinite(f[0])] for f in dynamics.innovations(fit.tables)]
    found = [f for f in found if f.shape[1] >= LEAST_BLOCK_STEPS]
    noise = np.empty((draws, m, steps))
    for d in range(draws):
        for i in range(m):
            source = found[rng.integers(len(found))][d]
            start = rng.integers(source.size)
            noise[d, i] = np.resize(np.roll(source, -start), steps)
    return noise


def _rewards(buffer: ReplayBuffer, i: int) -> Floats:
    """r_k of a session with its usable steps alone, [T]; NaN elsewhere."""
    session = buffer.sessions[i]
    return np.where(session.usable(), session.rewards(buffer.settings), np.nan)


def _blocks(rewards: Floats) -> Floats:
    """Sums over blocks [B] of rewards [T], as if every step were known; NaN where fewer than a third of a block is."""
    found = []
    for start in range(0, rewards.size - BLOCK + 1, BLOCK):
        block = rewards[start : start + BLOCK]
        known = np.isfinite(block)
        found.append(BLOCK * block[known].mean() if known.sum() >= LEAST_BLOCK_STEPS else np.nan)
    return np.array(found)


def _block_sums(runs: Floats, blocks: int) -> Floats:
    return runs[:, : blocks * BLOCK].reshape(len(runs), blocks, BLOCK).sum(-1)


def _log_density(seen: Floats, runs: Floats) -> float:
    """Of observed sums [B] in a normal with the mean and the shrunk covariance of runs [R, B], per session."""
    mean, covariance = runs.mean(0), np.atleast_2d(np.cov(runs, rowvar=False))
    diagonal = np.diag(covariance) + 1.0
    shrunk = (1 - SHRINK) * covariance
    shrunk[np.diag_indices(len(diagonal))] = diagonal
    lower = np.linalg.cholesky(shrunk)
    z = np.linalg.solve(lower, seen - mean)
    return float(-0.5 * z @ z - np.log(np.diag(lower)).sum() - 0.5 * seen.size * np.log(2 * np.pi))


def _compared(buffer: ReplayBuffer, k: int, runs: Floats) -> tuple[float, float]:
    """Mean reward per step of a session, predicted and observed, over the steps that are known; without the price of the amplitude."""
    rewards, price = _rewards(buffer, k), buffer.settings.c1 * held_amplitude(buffer.sessions[k])
    known = np.isfinite(rewards)
    return float((runs.mean(0) + price)[known].mean()), float((rewards + price)[known].mean())
