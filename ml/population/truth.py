"""The true expected return of a controller on a synthetic participant, by Monte Carlo, and the participant's reference beta amplitudes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ml.designs import DEFAULT_BOUND, Bound
from ml.mdp import MdpSettings, end_reward, step_reward
from ml.policies.policy import ConstantPolicy
from ml.population.controllers import Controller
from ml.population.outcomes import MEASURED
from ml.population.participants import ParticipantModel, ReferenceBeta
from ml.population.sessions import Floats, SessionBatch, run_sessions
from ml.progress import Report, silent

HOURS_OF_A_DAY: Final = 6.0
VISITS: Final = 12


@dataclass(frozen=True)
class Figure:
    """A mean over sessions and its standard error."""

    mean: float
    standard_error: float


@dataclass(frozen=True, kw_only=True)
class TrueReturn:
    """True return of a controller on a participant.

    Attributes:
        total: E[r_end + sum over t < steps of gamma^t r_t]. step_return, end_reward: its two parts.
        energy: mean squared amplitude fraction. beta: mean P_beta in uV. qocs: of each measured outcome, by `Outcome.field`.
        returns: total return of every session, [sessions].
        sessions, steps, seed: how it was measured; the same seed gives every controller the same days and the same noise.
    """

    total: Figure
    step_return: Figure
    end_reward: Figure
    energy: Figure
    beta: Figure
    qocs: Mapping[str, Figure]
    returns: Floats
    sessions: int
    steps: int
    seed: int

    @property
    def mean(self) -> float:
        """Mean total return."""
        return self.total.mean

    @property
    def standard_error(self) -> float:
        """Its standard error."""
        return self.total.standard_error


def true_return(
    policy: Controller,
    participant: ParticipantModel | str,
    settings: MdpSettings,
    *,
    sessions: int = 200,
    seed: int = 0,
    steps: int = 300,
    threads: int = 1,
    report: Report = silent,
) -> TrueReturn:
    """Estimate the expected return of a controller over days, hours and noise (eq:ope_total_return).

    Args:
        policy: a policy, `random` (on [settings.bound, 1]), `cdbs` or `no_dbs`.
        settings: MDP constants; the window is that of the state, the period must be 2 s.
        sessions: number of independent sessions, each on a day of its own, at a uniform hour of the day.
        steps: horizon H.

    Raises:
        ValueError: fewer than two sessions, or a period other than 2 s.
    """
    batch = sample_sessions(
        policy,
        participant,
        sessions=sessions,
        seed=seed,
        steps=steps,
        window=settings.window,
        bound=settings.bound,
        threads=threads,
        report=report,
    )
    if settings.period_s != 2.0:
        raise ValueError(f"the synthetic participants run at a period of 2 s, not {settings.period_s} s")
    discount = settings.gamma ** np.arange(steps)
    step_returns = (step_reward(settings, batch.beta, batch.amplitude) * discount).sum(axis=1)
    ends = np.array([end_reward(settings, outcome.qoc) for outcome in batch.outcomes], dtype=np.float64)
    returns = step_returns + ends
    return TrueReturn(
        total=_figure(returns),
        step_return=_figure(step_returns),
        end_reward=_figure(ends),
        energy=_figure((batch.amplitude**2).mean(axis=1)),
        beta=_figure(batch.beta.mean(axis=1)),
        qocs={name: _figure([getattr(o.qoc, name) for o in batch.outcomes]) for name in MEASURED},
        returns=returns,
        sessions=sessions,
        steps=steps,
        seed=seed,
    )


def sample_sessions(
    policy: Controller,
    participant: ParticipantModel | str,
    *,
    sessions: int,
    seed: int,
    steps: int,
    window: int = 10,
    bound: Bound = DEFAULT_BOUND,
    threads: int = 1,
    report: Report = silent,
) -> SessionBatch:
    """Simulate independent sessions: days, hours (stratified over the day), visits and noise from `seed` alone, whatever the controller."""
    if sessions < 2:
        raise ValueError(f"a standard error needs at least two sessions, not {sessions}")
    rng = np.random.default_rng([seed, 0x7275])
    hours = (rng.permutation(sessions) + rng.random(sessions)) * (HOURS_OF_A_DAY / sessions)
    return run_sessions(
        participant,
        policy,
        visits=rng.integers(1, VISITS + 1, sessions),
        hours=hours,
        seeds=rng.integers(0, 2**63, sessions, dtype=np.uint64),
        study_seed=rng.integers(1, 2**62, sessions),
        steps=steps,
        lead_steps=window,
        bound=bound,
        threads=threads,
        report=report,
    )


def measure_reference(participant: ParticipantModel | str, *, sessions: int = 200, seed: int = 0, threads: int = 1) -> ReferenceBeta:
    """Measure mean beta amplitudes of 10 min sessions under cDBS, amplitude fraction 0.3 and no stimulation."""
    levels: dict[str, Controller] = {"cdbs": "cdbs", "at_03": ConstantPolicy(0.3), "off": "no_dbs"}
    common: dict[str, Any] = {"sessions": sessions, "seed": seed, "steps": 300, "threads": threads}
    means = {name: float(sample_sessions(level, participant, **common).beta.mean()) for name, level in levels.items()}
    return ReferenceBeta(**means)


def _figure(values: NDArray[Any] | list[Any]) -> Figure:
    array = np.asarray(values, dtype=np.float64)
    return Figure(float(array.mean()), float(array.std(ddof=1)) / math.sqrt(array.size))
