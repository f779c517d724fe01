"""Amplitudes of a session as methods use them: gaps filled, the dose before the session, and memories of past amplitudes.

The window of beta alone is no Markov state, because stimulation acts over minutes. Exponential averages of the amplitudes so far are known
in the log and under any policy, so methods add them to the window. Where no record has the dose before a session, `ml.ope.lead` infers it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from ml.trajectories import SessionTrajectory

Floats = NDArray[np.float64]

DECAYS = (0.8, 0.95, 0.985)
"""Memories of past amplitudes: exponential averages with time constants of about 5, 20 and 66 steps."""


def remember(memory: Floats, a: Floats) -> Floats:
    """Update memories [N, 3] by the amplitudes [N]."""
    decay = np.array(DECAYS)
    return memory * decay + (1 - decay) * a[:, None]


def fresh_memory(a: Floats) -> Floats:
    """Make memories [N, 3] as if the amplitudes [N] had been on for long."""
    return np.tile(a[:, None], (1, len(DECAYS)))


def held_amplitude(session: SessionTrajectory) -> Floats:
    """Fill amplitudes [T] within [0, 1]: unknown ones take the value before, those at the start the first known (0 where none is)."""
    a = np.clip(session.amplitude, 0.0, 1.0)
    known = np.isfinite(a)
    if not known.any():
        return np.zeros(session.steps)
    last = np.maximum.accumulate(np.where(known, np.arange(a.size), -1))
    return np.asarray(a[np.where(last < 0, int(np.argmax(known)), last)], dtype=np.float64)


def lead_dose(session: SessionTrajectory, otherwise: float | None) -> float | None:
    """Find the amplitude fraction within [0, 1] that had been on before a session: the one on record, else `otherwise`. None: its first
    one."""
    return otherwise if session.lead_amplitude is None else min(max(session.lead_amplitude, 0.0), 1.0)


def lead_doses(sessions: Sequence[SessionTrajectory], otherwise: float | None) -> Floats:
    """Apply `lead_dose` to every session, [n]; NaN where that is None."""
    return np.array([np.nan if (dose := lead_dose(s, otherwise)) is None else dose for s in sessions], dtype=np.float64)


def after_doses(first: Floats, before: Floats) -> Floats:
    """Combine the amplitudes [..., n] that had been on before sessions [n]: `lead_doses`, and their first ones [..., n] where those are
    NaN."""
    return np.where(np.isnan(before), first, before)


def memories(a: Floats, before: float | None = None) -> Floats:
    """Compute memories [T, 3] of a session's amplitudes [T], each row with its own step in it.

    Args:
        before: amplitude that had been on for long before the session; its own first one where that is None.
    """
    first = a[0] if before is None else before
    passed = [scipy.signal.lfilter([1 - decay], [1, -decay], a, zi=np.array([decay * first]))[0] for decay in DECAYS]
    return np.stack(passed, axis=1)
