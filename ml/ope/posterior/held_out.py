"""Skill of each structure on sessions that it has not learnt from, and the weights that follow from it.

Each session in turn is excluded from a structure's coefficients; its autoregression and hyperparameters stay. The session runs freely from
its own window under its own logged amplitudes. It has a level that its visit suggests, and innovations of other sessions. Sums of the
rewards over blocks of 30 steps count, since the return is made of them. Their joint density is that of a normal with the runs' mean and
covariance. Weights follow from the log densities of sessions by pseudo-BMA with the Bayesian bootstrap (Yao, Vehtari, Simpson and Gelman
2018). A structure that is ahead by the luck of a few sessions does not take all the weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.mdp import step_reward
from ml.ope.doses import held_amplitude
from ml.ope.linear.dynamics import noise_features
from ml.ope.posterior.structures import Fit, LinearForm, take
from ml.ope.scale import Scale
from ml.statistics.left_out import left_out_draws
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

BLOCK = 30
"""Steps of a block."""
RUNS = 40
"""Free runs behind the density of a left-out session."""
SHRINK = 0.3
"""Share of the runs' covariance that is taken from its diagonal: 40 runs do not determine ten blocks' covariances."""
OWN_VARIANCE = 1.0
"""Variance of a block's sum that no run shows, in squared rewards: sums of few distinct rewards are no normals."""
LEARNING_RATE = 0.25
"""Power of the densities. Every structure is wrong in its own way: one that is far ahead here is less so on other policies (generalised
Bayes; Grünwald and van Ommen 2017)."""
RESAMPLES = 1000
LEAST_KNOWN = 10
"""Known steps below which a block, or a session's innovations, count for nothing."""


@dataclass(frozen=True)
class HeldOut:
    """Predictions of left-out sessions.

    Attributes:
        densities: log density of each session's block sums, structure -> [n]; NaN where a session could not be held out.
        predicted: mean reward of each session's known steps without the price of the amplitude, structure -> [n]. observed: it, [n].
        weights: of the structures, summing to 1.
    """

    densities: dict[str, Floats]
    predicted: dict[str, Floats]
    observed: Floats
    weights: dict[str, float]


def held_out(buffer: ReplayBuffer, scale: Scale, fits: Sequence[Fit], seed: int) -> HeldOut:
    """Leave every session with a whole first window out in turn."""
    n = len(buffer.sessions)
    densities, predicted = ({f.key: np.full(n, np.nan) for f in fits} for _ in range(2))
    rewards = [_known_rewards(buffer, i) for i in range(n)]
    prices = [buffer.settings.c1 * held_amplitude(s) for s in buffer.sessions]
    seen = [_blocks(r) for r in rewards]
    able = [i for i in range(n) if np.isfinite(seen[i]).any() and np.isfinite(buffer.sessions[i].lead_beta).all()]
    observed = np.full(n, np.nan)
    for i in able:
        observed[i] = np.nanmean(rewards[i] + prices[i])
    for fit in fits:
        runs = free_runs(fit, buffer, able, scale, seed)
        for i, run in zip(able, runs, strict=True):
            known = np.isfinite(seen[i])
            densities[fit.key][i] = log_density(seen[i][known], _block_sums(run, seen[i].size)[:, known])
            predicted[fit.key][i] = (run.mean(0) + prices[i])[np.isfinite(rewards[i])].mean()
    return HeldOut(densities, predicted, observed, weights_of(densities, seed))


def weights_of(densities: Mapping[str, Floats], seed: int) -> dict[str, float]:
    """Compute pseudo-BMA weights with the Bayesian bootstrap over sessions; equal ones where fewer than two sessions could be held out."""
    keys = list(densities)
    table = np.stack([densities[k] for k in keys])
    table = table[:, np.isfinite(table).all(0)]
    if table.shape[1] < 2:
        return dict.fromkeys(keys, 1 / len(keys))
    shares = np.random.default_rng([seed, 0xB0B0]).dirichlet(np.ones(table.shape[1]), RESAMPLES)
    totals = LEARNING_RATE * table.shape[1] * shares @ table.T
    each = np.exp(totals - totals.max(1, keepdims=True))
    return dict(zip(keys, (each / each.sum(1, keepdims=True)).mean(0).tolist(), strict=True))


def free_runs(fit: Fit, buffer: ReplayBuffer, held: Sequence[int], scale: Scale, seed: int) -> list[Floats]:
    """Compute the rewards of every held-out session in free runs under its own amplitudes, [RUNS, T] each."""
    rng = np.random.default_rng([seed, 0xF4EE])
    weights = np.array([f.weight for f in fit.forms])
    counts = rng.multinomial(RUNS, weights / weights.sum())
    parts = [_form_runs(fit, form, buffer, held, int(c), scale, rng) for form, c in zip(fit.forms, counts, strict=True) if c]
    joint = np.concatenate(parts)
    return [joint[:, k, : buffer.sessions[i].steps] for k, i in enumerate(held)]


def _form_runs(
    fit: Fit, form: LinearForm, buffer: ReplayBuffer, held: Sequence[int], runs: int, scale: Scale, rng: np.random.Generator
) -> Floats:
    """Compute the rewards of the held-out sessions in one form, [runs, m, T]."""
    window, sessions = form.phi.size, [buffer.sessions[i] for i in held]
    steps = max(s.steps for s in sessions)
    rest, amplitude = np.zeros((window + steps, runs, len(held))), np.ones((steps, len(held)))
    columns, levels = left_out_draws(form.model, form.sums, form.ratios, held, runs, rng)
    for j, i in enumerate(held):
        path = columns[j, :, 1:] @ form.answers[i].T + (columns[j, :, 0] + levels[j])[:, None]
        rest[: path.shape[1], :, j] = path.T
        amplitude[: sessions[j].steps, j] = held_amplitude(sessions[j])
    lead = scale.beta(np.stack([s.lead_beta for s in sessions]))
    noise = _innovations(fit, held, runs, steps, rng)
    betas = scale.raw_beta(_autoregressed(form, rest, amplitude, lead, noise, scale))
    rewards = step_reward(buffer.settings, betas, np.broadcast_to(amplitude[:, None], betas.shape))
    return np.ascontiguousarray(np.moveaxis(rewards, 0, -1))


def _autoregressed(form: LinearForm, rest: Floats, amplitude: Floats, lead: Floats, noise: Floats, scale: Scale) -> Floats:
    """Run standardised beta [T, runs, m] around its rest [W + T, runs, m] from windows [m, W], with standardised innovations [T, runs,
    m]."""
    window = form.phi.size
    low, high = scale.beta(np.array([scale.beta_low, scale.beta_high]))
    reach = 0.25 * (high - low)
    eta = np.empty(rest.shape)
    eta[:window] = lead.T[:, None] - rest[:window]
    for t in range(window, len(rest)):
        predicted = rest[t] + np.tensordot(form.phi[::-1], eta[t - window : t], 1)
        size = np.exp(noise_features(np.broadcast_to(amplitude[t - window], predicted.shape), predicted) @ form.noise_weights)
        eta[t] = np.clip(predicted + size * noise[t - window], low - reach, high + reach) - rest[t]
    return np.asarray((eta + rest)[window:], dtype=np.float64)


def _innovations(fit: Fit, held: Sequence[int], runs: int, steps: int, rng: np.random.Generator) -> Floats:
    """Draw standardised innovations [T, runs, m]: for each a run of those of another session, in their order."""
    found = take(fit.drawn, np.arange(1)).innovations(fit.tables)
    known = {i: f[0][np.isfinite(f[0])] for i, f in enumerate(found)}
    donors = [i for i, f in known.items() if f.size >= LEAST_KNOWN]
    noise = np.empty((steps, runs, len(held)))
    for j, i in enumerate(held):
        others = [d for d in donors if d != i] or donors
        for r, d in enumerate(rng.choice(others, runs)):
            noise[:, r, j] = known[d].take(np.arange(steps) + rng.integers(known[d].size), mode="wrap")
    return noise


def _known_rewards(buffer: ReplayBuffer, i: int) -> Floats:
    """Compute r_k of a session's usable steps, [T]; NaN elsewhere."""
    session = buffer.sessions[i]
    return np.where(session.usable(), session.rewards(buffer.settings), np.nan)


def _blocks(rewards: Floats) -> Floats:
    """Sum rewards over blocks [B], from rewards [T], as if every step were known; NaN where fewer than `LEAST_KNOWN` are."""
    found = []
    for start in range(0, rewards.size - BLOCK + 1, BLOCK):
        block = rewards[start : start + BLOCK]
        known = np.isfinite(block)
        found.append(BLOCK * float(block[known].mean()) if known.sum() >= LEAST_KNOWN else np.nan)
    return np.array(found)


def _block_sums(runs: Floats, blocks: int) -> Floats:
    return np.asarray(runs[:, : blocks * BLOCK].reshape(len(runs), blocks, BLOCK).sum(-1), dtype=np.float64)


def log_density(seen: Floats, runs: Floats) -> float:
    """Compute the log density of observed sums [B] in a normal with the mean and the shrunk covariance of runs [R, B]."""
    mean, covariance = runs.mean(0), np.atleast_2d(np.cov(runs, rowvar=False))
    shrunk = (1 - SHRINK) * covariance
    shrunk[np.diag_indices(len(shrunk))] = np.diag(covariance) + OWN_VARIANCE
    lower = np.linalg.cholesky(shrunk)
    z = np.linalg.solve(lower, seen - mean)
    return float(-0.5 * z @ z - np.log(np.diag(lower)).sum() - 0.5 * seen.size * np.log(2 * np.pi))
