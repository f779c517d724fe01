"""A linear autoregression of beta whose roots are kept inside the unit circle, chosen by free-running prediction of left-out sessions.

A one-step regression on sessions that differ in level learns a root near one: session after session looks like a slow walk. Run freely,
such a model forgets where the level lies and what the amplitude does to it. So the roots are shrunk (every lag's weight is multiplied by
kappa^lag, which multiplies every root by kappa), the other weights are fitted again around them, and kappa and the ridge penalty are those
that predict best when left-out sessions, and whole left-out controllers, are replayed from their first window with their own amplitudes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ml.ope.batches import Scale
from ml.ope.behaviour import controllers
from ml.ope.steps import fresh_memory, held_amplitude, memories, remember
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

PENALTIES = tuple(float(v) for v in 10.0 ** np.arange(-1, 5))
SHRINKAGES = (1.0, 0.95, 0.85, 0.6, 0.0)
"""kappa; 0 is a static model of amplitude and its memories."""

DAY_PENALTIES = (30.0, float("inf"))
"""Ridge penalty of each visit's own level, in steps: finite lets a good day not be taken for a good amplitude, infinite leaves it out."""

CANDIDATES = tuple(product(PENALTIES, SHRINKAGES, DAY_PENALTIES))
LARGEST_ROOT = 0.98
"""No fit keeps a root of larger modulus: its memory would outlast 50 steps."""

REPLAY_BLOCK = 30
"""Steps whose mean beta is compared in a replay: single steps are noise, and the reward follows levels."""

DOSE = 6
"""Column W + this of the features is the amplitude's memory over about 20 steps: the dose."""

NOISE_LIMIT = 3.0
SATURATION = 0.3


def features(window: Floats, a: Floats, memory: Floats) -> Floats:
    """Regressors of the next beta, [N, W + 13]: 1, the window, two products with its newest beta, then terms of the amplitude alone.

    Args:
        window: standardised, oldest first, [N, W]. a: amplitude, [N]. memory: memories of amplitudes with a in them, [N, 3].
    """
    newest = window[:, -1:]
    dose = memory[:, :2]
    own = [a[:, None], a[:, None] ** 2, memory, memory**2, dose / (dose + SATURATION)]
    return np.concatenate([np.ones((len(a), 1)), window, a[:, None] * newest, memory[:, 1:2] * newest, *own], axis=1)


def noise_features(a: Floats, predicted: Floats) -> Floats:
    """Regressors of the log scale of a residual, [N, 3]."""
    return np.stack([np.ones_like(a), a, np.clip(predicted, -NOISE_LIMIT, NOISE_LIMIT)], axis=1)


@dataclass(frozen=True)
class Regression:
    """Sessions as regression tables and their sums.

    Attributes:
        window: W. visits: numbers of the visits, [V]; column F - V + j of the features is 1 in the sessions of the j-th.
        x, y, a: features [K, F], standardised next beta [K] and amplitude [K] of the usable steps, per session.
        grams, moments: X^T X [n, F, F] and X^T y [n, F]. spread: variance of every column, [F]. usable: sessions with a usable step.
    """

    window: int
    visits: tuple[int, ...]
    x: list[Floats]
    y: list[Floats]
    a: list[Floats]
    grams: Floats
    moments: Floats
    spread: Floats
    usable: list[int]


def regression(buffer: ReplayBuffer, scale: Scale) -> Regression:
    """Tables of a buffer."""
    visits = tuple(sorted({s.visit for s in buffer.sessions}))
    tables = [_session_table(s, scale, visits) for s in buffer.sessions]
    x, y, a = ([t[j] for t in tables] for j in range(3))
    spread = np.concatenate(x).var(axis=0)
    return Regression(
        window=buffer.settings.window,
        visits=visits,
        x=x,
        y=y,
        a=a,
        grams=np.stack([v.T @ v for v in x]),
        moments=np.stack([v.T @ w for v, w in zip(x, y, strict=True)]),
        spread=np.maximum(spread, 1e-9),
        usable=[k for k, v in enumerate(x) if len(v)],
    )


def fit_weights(data: Regression, pick: Indices, penalty: float, shrinkage: float, day_penalty: float = float("inf")) -> Floats:
    """Weights [F] of the picked sessions with roots shrunk by `shrinkage` and none beyond `LARGEST_ROOT`."""
    gram, moment = data.grams[pick].sum(0), data.moments[pick].sum(0)
    ridge = penalty * data.spread
    # The slope of the dose is not shrunk: without it, stimulating less would look free, and policies be ranked the wrong way round.
    ridge[[0, data.window + DOSE]] = 1e-6
    # A level is kept for as long as the roots remember, so the same level of beta is a smaller weight: the penalty is that of the weight.
    ridge[len(ridge) - len(data.visits) :] = min(day_penalty, 1e12)
    gram = gram + np.diag(ridge)
    free = np.linalg.solve(gram, moment)
    root = largest_root(free, data.window)
    kappa = min(shrinkage, LARGEST_ROOT / root) if root > 0 else shrinkage
    if kappa >= 1.0:
        return np.asarray(free, dtype=np.float64)
    answers = np.arange(1, data.window + 3)
    rest = np.setdiff1d(np.arange(len(free)), answers)
    weights = free.copy()
    weights[answers] *= kappa ** lags(data.window)
    weights[rest] = np.linalg.solve(gram[np.ix_(rest, rest)], moment[rest] - gram[np.ix_(rest, answers)] @ weights[answers])
    return np.asarray(weights, dtype=np.float64)


def lags(window: int) -> Floats:
    """Lag of each column that holds beta: W ... 1 of the window, and 1 of both products, [W + 2]."""
    return np.concatenate([np.arange(window, 0, -1), [1, 1]]).astype(np.float64)


def largest_root(weights: Floats, window: int) -> float:
    """Largest modulus of a root of the autoregression over all amplitudes and memories in [0, 1]: its corners suffice."""
    moduli = []
    for a, m in product((0.0, 1.0), repeat=2):
        lagged = weights[1 : window + 1][::-1].copy()
        lagged[0] += a * weights[window + 1] + m * weights[window + 2]
        roots = np.roots(np.concatenate([[1.0], -lagged]))
        moduli.append(float(np.abs(roots).max()) if roots.size else 0.0)
    return max(moduli)


def replay_errors(buffer: ReplayBuffer, scale: Scale, data: Regression, folds: Sequence[Sequence[int]]) -> Floats:
    """Squared error of every candidate on every left-out session, [C, n]: block means of standardised beta in a free run from s_0.

    NaN where a session cannot be replayed (gaps in s_0, or no usable step). The conditional mean is run without noise: the model is linear
    in beta, so that this is the mean over noise.
    """
    errors = np.full((len(CANDIDATES), len(buffer.sessions)), np.nan)
    for fold in folds:
        rest = np.array([k for k in data.usable if k not in set(fold)], dtype=np.int64)
        held = [k for k in fold if k in data.usable and np.isfinite(buffer.sessions[k].lead_beta).all()]
        if not len(rest) or not held:
            continue
        weights = np.stack([fit_weights(data, rest, *candidate) for candidate in CANDIDATES])
        sessions = [buffer.sessions[k] for k in held]
        predicted = mean_path(weights, sessions, scale, data.visits)
        for j, (k, session) in enumerate(zip(held, sessions, strict=True)):
            seen = scale.beta(session.beta)
            errors[:, k] = block_error(seen, predicted[:, j, : session.steps])
    return errors


def mean_path(weights: Floats, sessions: Sequence[SessionTrajectory], scale: Scale, visits: Sequence[int]) -> Floats:
    """Free runs of every fit [C, F] from the sessions' first windows under their logged amplitudes, standardised, [C, n, longest T]."""
    fits, n, longest = len(weights), len(sessions), max(s.steps for s in sessions)
    amplitude = np.stack([np.append(held, np.full(longest - held.size, held[-1])) for held in map(held_amplitude, sessions)])
    window = np.tile(np.stack([scale.beta(s.lead_beta) for s in sessions]), (fits, 1))
    each = np.repeat(weights[:, : weights.shape[1] - len(visits)], n, axis=0)
    day = (weights[:, weights.shape[1] - len(visits) :] @ day_columns(visits, [s.visit for s in sessions]).T).reshape(-1)
    memory = fresh_memory(amplitude[:, 0])
    paths = np.empty((longest, fits * n))
    limit = 4.0 * (1.0 + float(np.abs(scale.beta(np.array([scale.beta_low, scale.beta_high]))).max()))
    for t in range(longest):
        a = amplitude[:, t]
        memory = memory if t == 0 else remember(memory, a)
        x = features(window, np.tile(a, fits), np.tile(memory, (fits, 1)))
        newest = np.clip(np.einsum("ij,ij->i", x, each) + day, -limit, limit)
        window = np.concatenate([window[:, 1:], newest[:, None]], axis=1)
        paths[t] = newest
    return np.asarray(paths.T.reshape(fits, n, longest), dtype=np.float64)


def replay_folds(buffer: ReplayBuffer, random_folds: Sequence[Sequence[int]]) -> list[list[list[int]]]:
    """Two ways to leave sessions out: groups of all kinds, and, where there are several, whole controllers."""
    kinds = list(controllers(buffer).values())
    ways = [[list(fold) for fold in random_folds]]
    return [*ways, kinds] if len(kinds) > 1 else ways


def choose(errors: Sequence[Floats], ways: Sequence[Sequence[Sequence[int]]], pick: Indices | None = None) -> int:
    """Candidate of the least error over the picked sessions (repeats count), averaged over the ways of leaving out.

    Every fold of a way counts the same, however many sessions it has: a controller that ran once, such as no stimulation, says as much of
    the answer to the amplitude as one that ran twenty times. Each way counts relative to its best candidate.
    """
    total = np.zeros(len(CANDIDATES))
    for table, folds in zip(errors, ways, strict=True):
        times = np.ones(table.shape[1]) if pick is None else np.bincount(pick, minlength=table.shape[1]).astype(np.float64)
        times = np.where(np.isfinite(table).all(axis=0), times, 0.0)
        values = np.where(times > 0, table, 0.0)
        means = [values[:, fold] @ times[fold] / times[fold].sum() for fold in map(list, folds) if times[fold].sum() > 0]
        if means:
            mean = np.mean(means, axis=0)
            total += mean / max(float(mean.min()), 1e-12)
    return int(np.argmin(total))


def noise_model(data: Regression, weights: Floats) -> tuple[Floats, Floats]:
    """Weights of the log scale of residuals, [3], and standardised residuals in order of time, padded by repetition, [n usable, L]."""
    designs, logs, residuals = [], [], []
    for k in data.usable:
        predicted = data.x[k] @ weights
        residual = data.y[k] - predicted
        designs.append(noise_features(data.a[k], predicted))
        logs.append(np.log(np.maximum(np.abs(residual), 1e-6)))
        residuals.append(residual)
    design, target = np.concatenate(designs), np.concatenate(logs)
    noise = np.linalg.solve(design.T @ design + np.diag([1e-6, 10.0, 10.0]), design.T @ target)
    scaled = [r * np.exp(-(d @ noise)) for r, d in zip(residuals, designs, strict=True)]
    longest = max(len(r) for r in scaled)
    return noise, np.stack([np.resize(r, longest) for r in scaled])


def day_columns(visits: Sequence[int], of: Sequence[int]) -> Floats:
    """Which of the visits [V] each of some sessions belongs to, [n, V]; all 0 for a visit that is not among them."""
    return np.asarray(np.asarray(of)[:, None] == np.asarray(visits)[None, :], dtype=np.float64)


def _session_table(session: SessionTrajectory, scale: Scale, visits: Sequence[int]) -> tuple[Floats, Floats, Floats]:
    usable = session.usable()
    a = held_amplitude(session)
    windows = scale.beta(session.states()[:-1][usable])
    own = features(windows, a[usable], memories(a)[usable])
    day = np.repeat(day_columns(visits, [session.visit]), len(own), axis=0)
    return np.concatenate([own, day], axis=1), scale.beta(session.beta[usable]), a[usable]


def block_error(seen: Floats, predicted: Floats) -> Floats:
    """Mean over blocks of the squared difference of block means, [C], for beta [T] with gaps and predictions [C, T]."""
    squares = []
    for start in range(0, seen.size, REPLAY_BLOCK):
        known = np.isfinite(seen[start : start + REPLAY_BLOCK])
        if known.sum() >= REPLAY_BLOCK // 3 or (known.any() and seen.size < REPLAY_BLOCK):
            block = predicted[:, start : start + REPLAY_BLOCK][:, known]
            squares.append((block.mean(1) - seen[start : start + REPLAY_BLOCK][known].mean()) ** 2)
    return np.asarray(np.mean(squares, axis=0) if squares else np.full(len(predicted), np.nan), dtype=np.float64)
