"""Two small simulators of beta under stimulation, unrelated to the synthetic cohort: one linear, one with a hidden slow state."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ml.mdp import MdpSettings, step_reward
from ml.policies.policy import ConstantPolicy, Policy, ProportionalPolicy
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory

WINDOW = 10
Act = Callable[[np.ndarray], np.ndarray]


class Simulator:
    """Sessions of a made-up participant; `kind` is `linear` or `hidden`."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.xi = {"linear": 0.86, "hidden": 0.70}[kind]
        self.settings = MdpSettings(xi_beta=self.xi)

    def run(self, rng: np.random.Generator, n: int, steps: int, act: Act) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulate beta [n, W + T], amplitude [n, T] and (grasp, rating, tremor) [n, 3] of n sessions."""
        base = np.exp(0.05 * rng.standard_normal(n)) if self.kind == "hidden" else np.ones(n)
        beta = np.empty((n, WINDOW + steps))
        beta[:, :WINDOW] = base[:, None] + 0.15 * rng.standard_normal((n, WINDOW))
        amplitude = np.empty((n, steps))
        slow, effect = np.zeros(n), np.full(n, 0.65)
        for t in range(steps):
            a = amplitude[:, t] = act(beta[:, t : t + WINDOW])
            last, before = beta[:, WINDOW + t - 1], beta[:, WINDOW + t - 2]
            if self.kind == "linear":
                beta[:, WINDOW + t] = 0.55 + 0.45 * last + 0.1 * before - 0.25 * a + 0.1 * rng.standard_normal(n)
                continue
            slow = 0.97 * slow - 0.0105 * a**0.7 + 0.012 * rng.standard_normal(n)
            effect += 0.4 * (a - effect)
            level = slow - 0.35 * effect**2 / (effect**2 + 0.3) + 0.15 * (np.log(last) - np.log(base))
            beta[:, WINDOW + t] = base * np.exp(level + 0.18 * rng.standard_normal(n))
        mean_a, mean_b = amplitude.mean(1), beta[:, WINDOW:].mean(1)
        grasp = np.maximum(2.6 - mean_b + 0.12 * rng.standard_normal(n), 0)
        rating = np.clip(np.round(10 - 5 * np.maximum(mean_b - 0.5, 0) - 1.5 * mean_a + 0.5 * rng.standard_normal(n)), 1, 10)
        tremor = np.clip(90 / (1 + np.exp(9 * (mean_a - 0.45))) + 3 * rng.standard_normal(n), 0, 100)
        return beta, amplitude, np.stack([grasp, rating, tremor], axis=1)

    def buffer(self, seed: int, n: int = 20, steps: int = 300) -> ReplayBuffer:
        """Simulate mostly random sessions, a few of cDBS, of a proportional controller and of a constant one; lengths vary."""
        rng = np.random.default_rng(seed)
        proportional = ProportionalPolicy(self.xi - 0.2, self.xi + 0.2, 0.3, 3)
        others: list[tuple[str, Policy]] = (
            [("cdbs", ConstantPolicy(1.0))] * 3 + [("rl", proportional)] * 2 + [("other", ConstantPolicy(0.3))]
        )
        plan: list[tuple[str, Policy | None]] = [("random", None)] * (n - len(others)) + list(others)
        sessions = []
        for i, (controller, policy) in enumerate(plan):
            act: Act = policy.act if policy is not None else (lambda s: rng.uniform(0.3, 1.0, len(s)))
            length = steps + int(rng.integers(-steps // 5, steps // 5 + 1))
            beta, amplitude, qoc = self.run(rng, 1, length, act)
            sessions.append(
                SessionTrajectory(
                    session_id=i,
                    visit=1 + i // 7,
                    controller=controller,
                    lead_beta=beta[0, :WINDOW],
                    beta=beta[0, WINDOW:],
                    amplitude=amplitude[0],
                    qoc=Qoc(float(qoc[0, 0]), int(qoc[0, 1]), float(qoc[0, 2])),
                    random_bound=0.3 if controller == "random" else None,
                )
            )
        return ReplayBuffer(self.settings, tuple(sessions), "uV", "table")

    def policies(self) -> dict[str, Policy]:
        """Build policies of varying quality; only cDBS is among those that made the data."""
        xi = self.xi
        return {
            **{f"constant {c}": ConstantPolicy(c) for c in (0.35, 0.5, 0.65, 0.8, 1.0)},
            "eager": ProportionalPolicy(xi - 0.3, xi + 0.05, 0.4, 2),
            "middle": ProportionalPolicy(xi - 0.15, xi + 0.15, 0.3, 1),
            "slow": ProportionalPolicy(xi - 0.05, xi + 0.15, 0.45, 10),
            "lazy": ProportionalPolicy(xi, xi + 0.4, 0.3, 1),
        }

    def truth(self, horizon: int = 300, n: int = 1000) -> dict[str, tuple[float, float]]:
        """Compute the expected step return and r_end of every policy, by Monte Carlo."""
        s, discount = self.settings, self.settings.gamma ** np.arange(horizon)
        result = {}
        for name, policy in self.policies().items():
            beta, a, qoc = self.run(np.random.default_rng(99), n, horizon, policy.act)
            step = (step_reward(s, beta[:, WINDOW:], a) * discount).sum(1).mean()
            end = (s.c2 * qoc[:, 0] + s.c3 * qoc[:, 1] - s.c4 * qoc[:, 2] / 100).mean()
            result[name] = (float(step), float(end))
        return result


@pytest.fixture(scope="session", params=["linear", "hidden"])
def simulator(request: pytest.FixtureRequest) -> Simulator:
    """Both simulators in turn."""
    return Simulator(request.param)


@pytest.fixture(scope="session")
def linear_simulator() -> Simulator:
    """The linear one."""
    return Simulator("linear")


@pytest.fixture(scope="session")
def small_buffer(linear_simulator: Simulator) -> ReplayBuffer:
    """Nine short sessions of unequal length."""
    return linear_simulator.buffer(seed=3, n=9, steps=40)
