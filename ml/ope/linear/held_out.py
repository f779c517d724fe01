"""Skill of the linear model's free runs on sessions that it has not learnt from. It is shown next to the estimates and decides nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ml.ope.linear.dynamics import Dynamics, SessionTable, fit_dynamics
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

BLOCK = 30
"""Steps whose mean beta is compared: single steps are noise, and the reward follows levels."""


def replay_skill(
    buffer: ReplayBuffer, tables: Sequence[SessionTable], folds: Sequence[Sequence[int]], before: float | None = None
) -> float | None:
    """Compute 1 - error / error of the learnt sessions' mean beta, over block means of held-out sessions run freely under their own
    amplitudes.

    A held-out session runs from its own s_0 at the level of its visit's other sessions. None where no session could be held out.

    Args:
        tables: of all sessions, made with the dose `before` those that say none.
    """
    error, plain = 0.0, 0.0
    for fold in folds:
        rest = [k for k in range(len(buffer.sessions)) if k not in set(fold)]
        learnt = [tables[k] for k in rest]
        held = [k for k in fold if np.isfinite(buffer.sessions[k].lead_beta).all() and buffer.sessions[k].usable().any()]
        if not held or sum(bool(t.usable.any()) for t in learnt) < 2:
            continue
        model, _ = fit_dynamics(replace(buffer, sessions=tuple(buffer.sessions[k] for k in rest)), learnt, 1, 0, before)
        mean = float(np.concatenate([t.beta[t.beta.size - t.usable.size :][t.usable] for t in learnt]).mean())
        visits = np.array([buffer.sessions[k].visit for k in rest])
        for k in held:
            same = visits == buffer.sessions[k].visit
            level = float(model.levels[0, same].mean() if same.any() else model.levels[0].mean())
            table = tables[k]
            seen = np.where(table.usable, table.beta[-table.usable.size :], np.nan)
            error += block_error(seen, mean_path(model, table, level))
            plain += block_error(seen, np.full(seen.size, mean))
    return 1 - error / plain if plain > 0 else None


def mean_path(model: Dynamics, table: SessionTable, level: float) -> Floats:
    """Compute the mean of standardised beta, [T], from a session's first window under its logged amplitudes at a level."""
    rest = table.answers @ model.beta[0] + level
    window = model.phi.size
    eta = np.concatenate([table.beta[:window] - rest[:window], np.zeros(table.usable.size)])
    for t in range(window, eta.size):
        eta[t] = eta[t - window : t] @ model.phi[::-1]
    return np.asarray((rest + eta)[window:], dtype=np.float64)


def block_error(seen: Floats, predicted: Floats) -> float:
    """Sum over blocks of the squared difference of block means, for beta [T] with gaps; blocks that are mostly gaps are excluded."""
    total = 0.0
    for start in range(0, seen.size, BLOCK):
        known = np.isfinite(seen[start : start + BLOCK])
        if known.sum() >= BLOCK // 3 or (known.any() and seen.size < BLOCK):
            total += float((predicted[start : start + BLOCK][known].mean() - seen[start : start + BLOCK][known].mean()) ** 2)
    return total
