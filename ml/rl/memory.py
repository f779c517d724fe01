"""Memory of a critic for past amplitudes: the recent dose, as far as beta has not yet answered it.

A beta window of W steps does not show which doses led to it. The answer to a dose comes within seconds to tens of minutes. A critic that
sees the window alone takes a slow answer for chance, or credits it to the amplitude of the moment. So it may also see the mean of past
amplitudes over three spans. The actor never does: a controller on the tablet is the paper's, a function of beta.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ml.trajectories import ReplayBuffer, SessionTrajectory, Transitions

Floats = NDArray[np.float64]

SPANS_S = (10.0, 60.0, 300.0)
"""Time constants of the exponentially weighted means, seconds."""
CLINICAL = 1.0
"""Amplitude fraction in force before a session where nothing else is known: sessions begin on clinical settings."""


def remembered(session: SessionTrajectory, period_s: float) -> Floats:
    """Compute past amplitudes before every step and after the last, [T + 1, 3], as 2a - 1 in [-1, 1], the critics' range of actions.

    m_{k+1} = m_k + (1 - exp(-period / span)) (a_k - m_k), from the amplitude in force before the session; an unknown amplitude leaves it.
    """
    rate = 1.0 - np.exp(-period_s / np.array(SPANS_S))
    means = np.empty((session.steps + 1, rate.size))
    means[0] = CLINICAL if session.lead_amplitude is None else session.lead_amplitude
    for k, amplitude in enumerate(session.amplitude):
        means[k + 1] = means[k] + (rate * (amplitude - means[k]) if np.isfinite(amplitude) else 0.0)
    return 2.0 * np.clip(means, 0.0, 1.0) - 1.0


def memory_of(buffer: ReplayBuffer, transitions: Transitions) -> tuple[Floats, Floats]:
    """Collect past amplitudes at the states of a buffer's transitions and at their next states, each [N, 3]."""
    each = [remembered(session, buffer.settings.period_s) for session in buffer.sessions]
    now, after = (np.stack([each[i][k + ahead] for i, k in zip(transitions.session, transitions.step, strict=True)]) for ahead in (0, 1))
    return now, after
