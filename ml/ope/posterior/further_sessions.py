"""How many further sessions near a dose would tell what cannot be told yet, by simulation.

Preposterior analysis (Raiffa and Schlaifer 1961, ch. 4): a truth is drawn from the posterior, the mean of n sessions under it is drawn
with the noise of sessions, the posterior is reweighted by the likelihood of that mean, and the verdict is asked again. n is the least
number with which it is told in four of five such futures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ml.ope.posterior.verdict import OUTCOMES, Levels
from ml.qoc import Qoc
from ml.returns import actual_return
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

NUMBERS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
"""Numbers of sessions that are tried; where none of them would do, no number is told."""

TOLD = 0.8
"""Share of simulated futures in which the verdict must be told."""

FUTURES = 200
_FEWEST = 3
"""Degrees of freedom from which the noise of sessions is known."""


def session_noise(buffer: ReplayBuffer) -> dict[str, float]:
    """Standard deviation of each outcome from session to session under one controller (and policy) at one visit.

    Random sessions of one visit may differ in dose by design, so they count only where the others have too few. An outcome is absent
    where fewer than three degrees of freedom speak about it. Units: Hz, points, percentage points.
    """
    groups: dict[tuple[object, ...], list[Qoc]] = {}
    for s in buffer.sessions:
        groups.setdefault((s.visit, s.controller, s.policy_id), []).append(s.qoc)
    steady = [rows for key, rows in groups.items() if key[1] != "random"]
    found = {}
    for name in OUTCOMES:
        for counted in (steady, list(groups.values())):
            deviation = _within_groups([[getattr(qoc, name) for qoc in rows] for rows in counted])
            if deviation:
                found[name] = deviation
                break
    return found


def return_noise(buffer: ReplayBuffer, horizon_steps: int) -> float:
    """Standard deviation of a session's return from session to session under one steady controller at one visit, reward units.

    0 where fewer than three degrees of freedom speak about it. A missing r_end leaves the session out where others have one; where no
    session has one, a return is its steps' part.
    """
    found = [(s, actual_return(s, buffer.settings, horizon_steps)) for s in buffer.sessions if s.controller != "random"]
    with_end = any(value.end_reward is not None for _, value in found)
    groups: dict[tuple[object, ...], list[float | None]] = {}
    for s, value in found:
        end = value.end_reward if with_end else 0.0
        whole = None if value.step_return is None or end is None else value.step_return + end
        groups.setdefault((s.visit, s.controller, s.policy_id), []).append(whole)
    return _within_groups(list(groups.values()))


def _within_groups(groups: Sequence[Sequence[float | None]]) -> float:
    """Pooled standard deviation within groups; 0 where there are too few values, or all of a group are the same."""
    squares, freedom = 0.0, 0
    for values in groups:
        known = np.array([v for v in values if v is not None], dtype=np.float64)
        if known.size > 1:
            squares += float(((known - known.mean()) ** 2).sum())
            freedom += known.size - 1
    return float(np.sqrt(squares / freedom)) if freedom >= _FEWEST else 0.0


def sessions_to_tell(
    gaps: Mapping[str, Floats], noise: Mapping[str, float], levels: Levels, *, already_near: int = 0, supported: bool = True, seed: int = 0
) -> int | None:
    """The least number of further sessions near the policy's dose with which it would be told as a test or as unsafe.

    Args:
        gaps: by how much each outcome keeps within its margin, draw by draw (`verdict.slacks`), [draws].
        noise: of a session, by outcome (`session_noise`). levels: of the verdict.
        already_near: sessions that were near already. supported: whether the data support the policy; else two near it are needed besides.
        seed: of the simulated futures.

    Returns:
        None where not even the largest of `NUMBERS` would do, or where the noise of no outcome is known.
    """
    names = [name for name in gaps if noise.get(name, 0.0) > 0]
    if not names:
        return None
    known = np.stack([gaps[name] for name in names], axis=1)
    others = [gaps[name] for name in gaps if name not in names]
    inside = np.min(np.stack([*known.T, *others]), axis=0) >= 0
    # a session of the policy less one of cDBS at the same visit: both have the noise
    error = np.sqrt(2.0) * np.array([noise[name] for name in names])
    rng = np.random.default_rng(seed)
    truths = rng.integers(0, len(known), FUTURES)
    shocks = rng.standard_normal((FUTURES, len(names)))
    least = 1 if supported else max(1, 2 - already_near)
    for n in NUMBERS:
        if n < least:
            continue
        spread = error / np.sqrt(n)
        seen = known[truths] + shocks * spread
        log_weight = -0.5 * (((seen[:, None, :] - known[None, :, :]) / spread) ** 2).sum(axis=2)
        weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
        within = (weight * inside).sum(axis=1) / weight.sum(axis=1)
        told = (within >= levels.test_within) | (1 - within >= levels.unsafe_beyond)
        if float(told.mean()) >= TOLD:
            return n
    return None
