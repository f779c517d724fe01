"""Draws of a mixed model for sessions excluded one by one: all of them side by side, from one set of sums."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ml.statistics.mixed import PERFECT, RIDGE, MixedModel, live_columns
from ml.statistics.nested import SessionSums

Floats = NDArray[np.float64]

BATCH: Final = 128
"""Sessions whose equations are kept at once."""


def left_out_draws(
    model: MixedModel, sums: SessionSums, ratios: Floats, held: Sequence[int], draws: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Draw for each held-out session what the other sessions predict of it, at given lambdas.

    A column that no other row has is drawn from its prior, and so is the level of the session itself.

    Args:
        model: of the sums. sums: of n sessions. ratios: lambda of every estimated group, those of visits and sessions last.
        `held`: held-out sessions, m, at least one. draws: D of each.

    Returns:
        Coefficients of the columns, [m, D, q], and the visit's plus the session's level, [m, D].
    """
    parts = [_batch(model, sums, ratios, np.asarray(held[k : k + BATCH]), draws, rng) for k in range(0, len(held), BATCH)]
    columns, levels = zip(*parts, strict=True)
    return np.concatenate(columns), np.concatenate(levels)


def _batch(
    model: MixedModel, sums: SessionSums, ratios: Floats, held: NDArray[np.int64], draws: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    m, n, q = len(held), len(sums.rows), model.columns
    each, groups = np.arange(m), list(model.estimated.values())
    present = np.ones((m, n))
    present[each, held] = 0.0
    diagonal = np.tensordot(present, np.diagonal(sums.joint, axis1=1, axis2=2)[:, :q], 1)
    of_session = present * sums.joint[:, 0, 0]
    of_visit = of_session @ (sums.visit[:, None] == np.arange(sums.visits))
    live = live_columns(diagonal)
    penalties = np.tile((RIDGE * (np.where(live, diagonal, 0.0).sum(1) + 2 * of_session.sum(1)))[:, None], q)
    for column, ratio in model.known.items():
        penalties[:, column] = 1 / ratio
    for columns, ratio in zip(groups, ratios[: len(groups)], strict=True):
        penalties[:, columns] = 1 / ratio
    at = sums.reduced(np.tile(ratios[len(groups) :], (m, 1)), present)
    inner = at.joint[:, :q, :q] + penalties[:, :, None] * np.eye(q)
    means = np.asarray(np.linalg.solve(inner, at.joint[:, :q, q:])[..., 0], dtype=np.float64)
    square = present @ sums.joint[:, -1, -1]
    left = np.maximum(at.joint[:, q, q] - np.sum(means * at.joint[:, :q, q], axis=1), PERFECT * square)
    free = np.setdiff1d(np.arange(q), [*model.known, *(c for columns in groups for c in columns)])
    sigma = np.sqrt(left / np.maximum(present @ sums.rows - live[:, free].sum(1), 1))
    noise = np.empty((m, draws, q + sums.visits + n))
    unseen: list[list[tuple[NDArray[np.int64], Floats]]] = []
    whole = [np.asarray(columns) for columns in groups] + [np.arange(q, q + sums.visits), np.arange(q + sums.visits, noise.shape[2])]
    seen = np.concatenate([live, of_visit > 0, of_session > 0], axis=1)
    for j in each:
        noise[j] = rng.standard_normal(noise.shape[1:])
        missing = [columns[~seen[j, columns]] for columns in whole]
        unseen.append([(c, np.sqrt(r) * rng.standard_normal((draws, c.size))) for c, r in zip(missing, ratios, strict=True)])
    drawn = sigma[:, None, None] * np.where(seen[:, None], sums.spread(at, penalties, noise), 0.0)
    drawn += np.concatenate([means, *sums.means(at, means)], axis=1)[:, None]
    for j in each:
        for missing_columns, values in unseen[j]:
            drawn[j][:, missing_columns] = sigma[j] * values
    levels = drawn[each, :, q + sums.visit[held]] + drawn[each, :, q + sums.visits + held]
    return drawn[..., :q], levels
