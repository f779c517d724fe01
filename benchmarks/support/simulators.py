"""Worlds to measure off-policy evaluation in: the synthetic participants, and two simulators whose dynamics are not theirs.

`saturating`: log beta is an autoregression of second order around a level with a hidden slow state per session; the effect of stimulation
saturates with the dose and comes in over minutes; Gaussian noise. `switching`: beta is high or low (bursts), stimulation shortens bursts
once it passes a threshold that drifts; heavy-tailed noise. Neither shares an equation or a constant with the cohort.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ml.mdp import MdpSettings, end_reward, step_reward
from ml.policies.policy import ConstantPolicy, Policy, ProportionalPolicy
from ml.population import PARTICIPANTS, true_return
from ml.population.physiology.medication import since_dose
from ml.population.sessions import run_sessions
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory

WINDOW, STEPS, NO_DBS_STEPS = 10, 300, 150
VISITS = {"P1": 3, "P2": 4, "P3": 5, "P4": 6, "saturating": 4, "switching": 4}
"""Visits of the data of each world."""
Floats = np.ndarray
Act = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Truth:
    """True expected return by Monte Carlo: total with its standard error, and its two parts."""

    total: float
    standard_error: float
    step_return: float
    end_reward: float


@dataclass(frozen=True)
class Planned:
    """One session of the data: what ran, when, and for how long."""

    controller: str
    visit: int
    policy: Policy | None = None
    policy_id: int | None = None
    steps: int = STEPS


class World(Protocol):
    """Something that sessions can be run in."""

    name: str
    settings: MdpSettings

    def data(self, seed: int, visits: int) -> ReplayBuffer:
        """Sessions of some visits."""

    def truth(self, policy: Policy, sessions: int) -> Truth:
        """True return of a policy."""

    def truth_on_days(self, policy: Policy, seed: int, visits: int, sessions: int) -> Truth | None:
        """What a policy would have returned on the very days of `data(seed, visits)`; None where days are all alike."""


def plan(xi: float, visits: int) -> Iterator[Planned]:
    """First a visit of random sessions; later ones with cDBS between adaptive controllers, one new one per visit."""
    yield from [Planned("random", 1)] * 4 + [Planned("cdbs", 1), Planned("no_dbs", 1, steps=NO_DBS_STEPS)]
    for visit in range(2, visits + 1):
        adaptive = ProportionalPolicy(xi * (0.65 + 0.05 * visit), xi * 1.25, 0.2 + 0.08 * visit, 2 + visit)
        ran = Planned("rl", visit, adaptive, visit)
        yield from [ran, Planned("cdbs", visit), ran, Planned("random", visit), Planned("random", visit)]


def _hour(i: int) -> float:
    """Hour of the day of the i-th session of the data."""
    return 0.4 + 0.9 * (i % 6)


class CohortWorld:
    """A synthetic participant."""

    def __init__(self, code: str) -> None:
        self.name, self.code = code, code
        self.settings = PARTICIPANTS[code].mdp_settings()

    def data(self, seed: int, visits: int) -> ReplayBuffer:
        sessions = []
        for i, planned in enumerate(plan(self.settings.xi_beta, visits)):
            lower = self.settings.lower_bound
            batch = run_sessions(
                self.code,
                planned.policy if planned.policy is not None else planned.controller,
                visits=planned.visit,
                hours=_hour(i),
                seeds=1000 * (seed + 1) + i,
                study_seed=seed + 1,
                steps=planned.steps,
                lower_bound=lower,
            )
            run = batch.session(0)
            bound = lower if planned.controller == "random" else None
            since = since_dose(PARTICIPANTS[self.code].regimen, _hour(i))
            sessions.append(_session(i, planned, run.lead_beta, run.beta, run.amplitude, run.outcomes.qoc, bound, since))
        return ReplayBuffer(self.settings, tuple(sessions), "uV", "table")

    def truth(self, policy: Policy, sessions: int) -> Truth:
        found = true_return(policy, self.code, self.settings, sessions=sessions, seed=77, steps=STEPS)
        return Truth(found.mean, found.standard_error, found.step_return.mean, found.end_reward.mean)

    def truth_on_days(self, policy: Policy, seed: int, visits: int, sessions: int) -> Truth | None:
        planned = list(plan(self.settings.xi_beta, visits))
        of = np.arange(sessions) % len(planned)
        batch = run_sessions(
            self.code,
            policy,
            visits=np.array([p.visit for p in planned])[of],
            hours=np.array([_hour(i) for i in range(len(planned))])[of],
            seeds=500_000 + np.arange(sessions, dtype=np.uint64),
            study_seed=seed + 1,
            steps=STEPS,
            lower_bound=self.settings.lower_bound,
        )
        s = self.settings
        steps = (step_reward(s, batch.beta, batch.amplitude) * s.gamma ** np.arange(STEPS)).sum(1)
        ends = np.array([end_reward(s, outcome.qoc) for outcome in batch.outcomes], dtype=np.float64)
        error = float((steps + ends).std(ddof=1) / math.sqrt(sessions))
        return Truth(float((steps + ends).mean()), error, float(steps.mean()), float(ends.mean()))


class OtherWorld:
    """What both other simulators share: sessions, outcomes, truth. `_run` is theirs."""

    name: str
    settings: MdpSettings

    def _run(self, rng: np.random.Generator, n: int, steps: int, act: Act) -> tuple[Floats, Floats]:
        """Beta [n, W + T] and amplitude [n, T]."""
        raise TypeError(f"{type(self).__name__} has no dynamics")

    def _outcomes(self, rng: np.random.Generator, beta: Floats, a: Floats) -> Floats:
        """Grasp, rating and tremor, [n, 3]: slowness follows the burden of beta, tremor the dose, the rating both and side effects."""
        burden = np.mean(np.maximum(beta[:, WINDOW:] / self.settings.xi_beta - 0.8, 0.0), axis=1)
        dose, late = a.mean(1), a[:, -60:].mean(1)
        n = len(beta)
        grasp = np.maximum(2.4 - 1.1 * np.sqrt(burden) + 0.15 * rng.standard_normal(n), 0.1)
        tremor = np.clip(70 * np.exp(-3.5 * late) + 6 * rng.standard_normal(n), 0, 100)
        rating = np.clip(np.round(9.5 - 3.5 * burden - 0.03 * tremor - 1.5 * dose**3 + 0.7 * rng.standard_normal(n)), 1, 10)
        return np.stack([grasp, rating, tremor], axis=1)

    def data(self, seed: int, visits: int) -> ReplayBuffer:
        rng = np.random.default_rng([seed, 5])
        fixed: dict[str, Act] = {
            "random": lambda s: rng.uniform(self.settings.lower_bound, 1.0, len(s)),
            "cdbs": ConstantPolicy(1.0).act,
            "no_dbs": ConstantPolicy(0.0).act,
        }
        sessions = []
        for i, planned in enumerate(plan(self.settings.xi_beta, visits)):
            act = planned.policy.act if planned.policy is not None else fixed[planned.controller]
            beta, a = self._run(rng, 1, planned.steps, act)
            grasp, rating, tremor = self._outcomes(rng, beta, a)[0]
            qoc = Qoc(float(grasp), int(rating), float(tremor))
            bound = self.settings.lower_bound if planned.controller == "random" else None
            sessions.append(_session(i, planned, beta[0, :WINDOW], beta[0, WINDOW:], a[0], qoc, bound))
        return ReplayBuffer(self.settings, tuple(sessions), "uV", "table")

    def truth(self, policy: Policy, sessions: int) -> Truth:
        rng = np.random.default_rng(77)
        beta, a = self._run(rng, sessions, STEPS, policy.act)
        grasp, rating, tremor = self._outcomes(rng, beta, a).T
        s = self.settings
        steps = (step_reward(s, beta[:, WINDOW:], a) * s.gamma ** np.arange(STEPS)).sum(1)
        ends = s.c2 * grasp + s.c3 * rating - s.c4 * tremor / (100 if s.tremor_as_fraction else 1)
        total = steps + ends
        return Truth(float(total.mean()), float(total.std(ddof=1) / math.sqrt(sessions)), float(steps.mean()), float(ends.mean()))

    def truth_on_days(self, policy: Policy, seed: int, visits: int, sessions: int) -> Truth | None:
        return None


class SaturatingWorld(OtherWorld):
    """Second-order log beta, a hidden slow state, a saturating dose."""

    name, settings = "saturating", MdpSettings(xi_beta=1.35)

    def _run(self, rng: np.random.Generator, n: int, steps: int, act: Act) -> tuple[Floats, Floats]:
        beta, amplitude = np.empty((n, WINDOW + steps)), np.empty((n, steps))
        level = 0.55 + 0.12 * rng.standard_normal(n)
        tissue, hidden = np.full(n, 1.0), 0.08 * rng.standard_normal(n)
        x1 = level - 0.5 + 0.2 * rng.standard_normal(n)
        x2 = x1.copy()
        for t in range(-WINDOW, steps):
            a = np.full(n, 1.0) if t < 0 else act(beta[:, t : t + WINDOW])
            tissue += (a - tissue) / 12.0
            hidden = 0.99 * hidden + 0.012 * rng.standard_normal(n)
            centre = level + hidden - 0.75 * tissue**1.5 / (tissue**1.5 + 0.25) * (1 + 0.1 * (x1 - level))
            x = centre + 0.5 * (x1 - centre) + 0.15 * (x2 - centre) + 0.17 * rng.standard_normal(n)
            x2, x1 = x1, x
            beta[:, WINDOW + t] = np.exp(x)
            if t >= 0:
                amplitude[:, t] = a
        return beta, amplitude


class SwitchingWorld(OtherWorld):
    """Bursts of high beta that stimulation above a drifting threshold shortens, under heavy-tailed noise."""

    name, settings = "switching", MdpSettings(xi_beta=1.6)

    def _run(self, rng: np.random.Generator, n: int, steps: int, act: Act) -> tuple[Floats, Floats]:
        beta, amplitude = np.empty((n, WINDOW + steps)), np.empty((n, steps))
        high = rng.random(n) < 0.3
        threshold = 0.45 + 0.08 * rng.standard_normal(n)
        gain = np.exp(0.1 * rng.standard_normal(n))
        carried = np.full(n, 1.0)
        for t in range(-WINDOW, steps):
            a = np.full(n, 1.0) if t < 0 else act(beta[:, t : t + WINDOW])
            carried = 0.7 * carried + 0.3 * a
            threshold = np.clip(threshold + 0.006 * rng.standard_normal(n), 0.2, 0.8)
            strong = 1 / (1 + np.exp(-(carried - threshold) / 0.06))
            enter, leave = 0.22 - 0.17 * strong, 0.08 + 0.32 * strong
            high = np.where(high, rng.random(n) > leave, rng.random(n) < enter)
            noise = 0.16 * rng.standard_t(4, n)
            beta[:, WINDOW + t] = gain * np.maximum(np.where(high, 2.2, 1.15 - 0.15 * carried) + noise, 0.05)
            if t >= 0:
                amplitude[:, t] = a
        return beta, amplitude


def _session(
    i: int,
    planned: Planned,
    lead: Floats,
    beta: Floats,
    amplitude: Floats,
    qoc: Qoc,
    lower_bound: float | None,
    medication_h: float | None = None,
) -> SessionTrajectory:
    return SessionTrajectory(
        session_id=i + 1,
        visit=planned.visit,
        controller=planned.controller,
        lead_beta=np.asarray(lead, dtype=np.float64),
        beta=np.asarray(beta, dtype=np.float64),
        amplitude=np.asarray(amplitude, dtype=np.float64),
        qoc=qoc,
        policy_id=planned.policy_id,
        random_lower_bound=lower_bound,
        medication_h=medication_h,
    )


WORLDS: dict[str, Callable[[], World]] = {
    **{code: (lambda c=code: CohortWorld(c)) for code in sorted(PARTICIPANTS)},
    "saturating": SaturatingWorld,
    "switching": SwitchingWorld,
}
