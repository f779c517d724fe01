"""Sessions of log beta whose answer to the amplitude is known."""

from __future__ import annotations

import numpy as np

from ml.mdp import MdpSettings
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory

WINDOW, STEPS = 10, 200


class KnownSystem:
    """Log beta = level - depth x (low-pass of the amplitude) + autoregression; sessions begin after the dose `before` (None: their own)."""

    def __init__(self, depth: float = 0.8, steps_constant: float = 30.0, before: float | None = 1.0, noise: float = 0.12) -> None:
        self.depth, self.keep, self.before, self.noise = depth, np.exp(-1 / steps_constant), before, noise

    def session(self, i: int, visit: int, controller: str, a: np.ndarray, rng: np.random.Generator) -> SessionTrajectory:
        first = a[0] if self.before is None else self.before
        dose, eta, x = first, 0.0, []
        level = 0.05 * rng.standard_normal()
        for value in [*[first] * WINDOW, *a]:
            dose = self.keep * dose + (1 - self.keep) * value
            eta = 0.5 * eta + self.noise * rng.standard_normal()
            x.append(level - self.depth * dose + eta)
        beta = np.exp(np.array(x))
        mean = float(a.mean())
        grasp = 2.0 + 0.5 * mean + 0.05 * rng.standard_normal()
        rating = int(np.clip(np.round(4 + 4 * mean + 0.3 * rng.standard_normal()), 1, 10))
        qoc = Qoc(grasp, rating, 0.0)
        return SessionTrajectory(i + 1, visit, controller, beta[:WINDOW], beta[WINDOW:], a, qoc)

    def buffer(self, seed: int = 0, visits: int = 3, hold: int = 20, weight: float = 10.0) -> ReplayBuffer:
        """Simulate visits of one cDBS session, four random ones at sustained levels of their own, and one without stimulation."""
        rng = np.random.default_rng(seed)
        sessions: list[SessionTrajectory] = []
        for visit in range(1, visits + 1):
            rows = [("cdbs", np.ones(STEPS))]
            for level in rng.permutation([0.4, 0.55, 0.7, 0.85]):
                rows.append(("random", np.repeat(np.clip(level + rng.uniform(-0.12, 0.12, STEPS // hold), 0.3, 1.0), hold)))
            rows.append(("no_dbs", np.zeros(STEPS // 2)))
            sessions += [self.session(len(sessions) + k, visit, name, a, rng) for k, (name, a) in enumerate(rows)]
        settings = MdpSettings(xi_beta=float(np.exp(-0.65 * self.depth)), c2=weight, c3=weight, c4=weight, lower_bound=0.3)
        return ReplayBuffer(settings, tuple(sessions), "uV", "table")
