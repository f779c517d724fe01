"""Support of policies by the logged sessions, by what sessions are as a whole: mean and late dose, burden of beta, switching.

A step's amplitude may have been tried a thousand times, and yet no session have kept it. A policy is supported where at least two sessions
on two visits are near what it would do. Its leverage says how far it is from all of them. It is the share of the variance of a smooth
function of the summaries that the sessions leave open. The function is a Gaussian process; the share is 0 near many sessions and 1 far from
all. Switching counts for the leverage alone: sustained amplitudes say little of a controller that changes them at every step, but it can be
judged.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.ope.doses import held_amplitude
from ml.ope.flags import Flag
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

SUMMARIES = ("mean dose", "late dose", "burden", "switching")
LATE_STEPS = 60
"""Steps before a session's end whose mean amplitude is its late dose."""

NEAR = np.array([0.10, 0.15, 0.30, np.inf])
"""A session is near a policy where no summary differs by more. These are amplitude fractions, the share of steps at or above the
threshold, and the mean change of the amplitude from step to step."""
LENGTHS = np.array([0.15, 0.20, 0.50, 0.10])
"""Distances over which a smooth function of the summaries changes."""
NOISE = 0.25
"""Variance of one session around that function, as a share of the function's own."""
FEWEST_SESSIONS, FEWEST_VISITS = 2, 2
FEWEST_STEPS = 60
"""Usable steps below which a session supports nothing."""
OFF = 0.05
"""Mean dose below which a session is one without stimulation: it supports no dose to test at."""


@dataclass(frozen=True)
class Support:
    """Logged sessions near one policy.

    Attributes:
        near_sessions, near_visits: sessions near it, and their visits. leverage: in [0, 1].
        dose: mean amplitude that it would give. lowest_supported: lowest mean dose that two sessions on two visits kept or went below.
            Sessions without stimulation do not count. None where there is none.
    """

    near_sessions: int
    near_visits: int
    leverage: float
    dose: float
    lowest_supported: float | None

    @property
    def supported(self) -> bool:
        """True where two sessions on two visits are near."""
        return self.near_sessions >= FEWEST_SESSIONS and self.near_visits >= FEWEST_VISITS

    @property
    def flags(self) -> tuple[Flag, ...]:
        """Reasons why the sessions do not support the policy; empty where they do."""
        if self.supported:
            return ()
        if self.near_sessions < FEWEST_SESSIONS:
            return (
                Flag.of("few_near_sessions", float(self.near_sessions), float(FEWEST_SESSIONS), "sessions", refuses=True, dose=self.dose),
            )
        return (Flag.of("few_near_visits", float(self.near_visits), float(FEWEST_VISITS), "visits", refuses=True, dose=self.dose),)

    def to_json(self) -> dict[str, Any]:
        """Return all numbers, by name."""
        return asdict(self)


class SessionSupport:
    """The summaries of a buffer's sessions, [n, 4], with which policies are compared."""

    def __init__(self, buffer: ReplayBuffer) -> None:
        kept = [s for s in buffer.sessions if s.usable().sum() >= FEWEST_STEPS]
        xi = buffer.settings.xi_beta
        rows = []
        for s in kept:
            a = held_amplitude(s)
            above = np.nanmean(np.where(np.isfinite(s.beta), s.beta >= xi, np.nan))
            rows.append([a.mean(), a[-LATE_STEPS:].mean(), above, np.abs(np.diff(a)).mean()])
        self.points = np.array(rows, dtype=np.float64).reshape(len(kept), len(SUMMARIES))
        self.visits = np.array([s.visit for s in kept], dtype=np.int64)
        gram = _kernel(self.points, self.points) + NOISE * np.eye(len(kept))
        self._inverse = np.linalg.inv(gram) if kept else np.zeros((0, 0))
        self.lowest = self._lowest()

    def of(self, summary: Floats) -> Support:
        """Compute the support of a policy whose sessions have the summaries [4] on average."""
        near = np.all(np.abs(self.points - summary) <= NEAR, axis=1)
        k = _kernel(summary[None], self.points)[0]
        leverage = float(np.clip(1 - k @ self._inverse @ k, 0.0, 1.0))
        return Support(int(near.sum()), int(np.unique(self.visits[near]).size), leverage, float(summary[0]), self.lowest)

    def _lowest(self) -> float | None:
        doses, visits = self.points[:, 0], self.visits
        on = np.flatnonzero(doses >= OFF)
        for i in on[np.argsort(doses[on], kind="stable")]:
            if np.unique(visits[on][doses[on] <= doses[i]]).size >= FEWEST_VISITS:
                return float(doses[i])
        return None


def _kernel(a: Floats, b: Floats) -> Floats:
    gap = (a[:, None, :] - b[None, :, :]) / LENGTHS
    return np.asarray(np.exp(-0.5 * np.sum(gap**2, axis=-1)), dtype=np.float64)
