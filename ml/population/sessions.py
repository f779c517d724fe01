"""Sessions of a synthetic participant: one controller, a window of beta before it, steps of 2 s, and what is measured at the end.

All sessions of a call advance together, each with its own random streams. So a session is the same, bit for bit, alone or among others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ml.designs import DEFAULT_BOUND, Bound
from ml.population.controllers import Controller, chooser, delivery, is_random
from ml.population.days import DayEffect, day_effect
from ml.population.outcomes import GRASP_TEST_STEPS, Outcomes, measure
from ml.population.participants import PARTICIPANTS, ParticipantModel
from ml.population.physiology import brain, symptoms
from ml.population.physiology.brain import PERIOD_S, SAMPLES_PER_PERIOD
from ml.population.physiology.medication import effect
from ml.progress import Report, silent
from ml.qoc import Qoc
from ml.trajectories import SessionTrajectory

Floats = NDArray[np.float64]

SETTLE_STEPS: Final = 5
"""Periods before the first beta that is kept: the fast dynamics and the band-pass forget their start within seconds."""
GRASP_GAIN: Final = 0.9
"""Factor on K while the hand moves: beta decreases with movement (PMC1474736); size assumed."""


@dataclass(frozen=True, kw_only=True)
class SimulatedSession:
    """One session. Beta amplitudes are in uV, the LFP in mV.

    Attributes:
        participant: code. controller: `random`, `cdbs`, `no_dbs`, `rl`, ... visit, hour, seed: as asked for.
        lead_beta: P_beta before step 0, [L], oldest first. beta: P_beta of each step, [T]. amplitude: amplitude fraction of each step, [T].
        lead_amplitude: amplitude fraction in force before step 0.
        bound: B of a random session, else None.
        lfp: 250 Hz, float32 mV, [(L + T) * 500], or None where it was not kept.
        outcomes: what was measured at the end, QoCs among it.
        hidden: what no device sees: `medication`, `activity`, `brady`, `tremor`, `overload`, each [T].
    """

    participant: str
    controller: str
    visit: int
    hour: float
    seed: int
    lead_beta: Floats
    beta: Floats
    amplitude: Floats
    lead_amplitude: float
    bound: Bound | None
    lfp: NDArray[np.float32] | None
    outcomes: Outcomes
    hidden: dict[str, Floats] = field(repr=False)

    @property
    def steps(self) -> int:
        """T."""
        return int(self.beta.size)

    @property
    def qoc(self) -> Qoc:
        """End-of-session QoCs."""
        return self.outcomes.qoc

    def trajectory(self, session_id: int, policy_id: int | None = None) -> SessionTrajectory:
        """Convert the session to a trajectory of the MDP; the lead is the window before it."""
        return SessionTrajectory(
            session_id=session_id,
            visit=self.visit,
            controller=self.controller,
            lead_beta=self.lead_beta,
            beta=self.beta,
            amplitude=self.amplitude,
            qoc=self.qoc,
            policy_id=policy_id,
            random_bound=self.bound,
        )


@dataclass(frozen=True, kw_only=True)
class SessionBatch:
    """N sessions of one participant under one controller; arrays as in `SimulatedSession` with a leading N."""

    participant: ParticipantModel
    controller: str
    visits: NDArray[np.int64]
    hours: Floats
    seeds: NDArray[np.uint64]
    lead_beta: Floats
    beta: Floats
    amplitude: Floats
    lead_amplitude: float
    bound: Bound | None
    lfp: NDArray[np.float32] | None
    outcomes: tuple[Outcomes, ...]
    hidden: dict[str, Floats] = field(repr=False)

    def __len__(self) -> int:
        return int(self.seeds.size)

    def session(self, i: int) -> SimulatedSession:
        """Extract session i of the batch."""
        return SimulatedSession(
            participant=self.participant.code,
            controller=self.controller,
            visit=int(self.visits[i]),
            hour=float(self.hours[i]),
            seed=int(self.seeds[i]),
            lead_beta=self.lead_beta[i],
            beta=self.beta[i],
            amplitude=self.amplitude[i],
            lead_amplitude=self.lead_amplitude,
            bound=self.bound,
            lfp=None if self.lfp is None else self.lfp[i],
            outcomes=self.outcomes[i],
            hidden={name: values[i] for name, values in self.hidden.items()},
        )


class Simulation:
    """N sessions in progress: `advance` runs one period. For roll-outs use `run_sessions`.

    Args:
        participant: who. visits, hours, seeds, study_seeds: of each session, [N].
        periods: how many periods will follow the settling, lead included.
        lead_amplitude: amplitude fraction that has been in force for long.
        threads: threads that share the sessions; the numbers do not depend on it.
    """

    def __init__(
        self,
        participant: ParticipantModel,
        *,
        visits: NDArray[np.int64],
        hours: Floats,
        seeds: NDArray[np.uint64],
        study_seeds: NDArray[np.int64],
        periods: int,
        lead_amplitude: float = 1.0,
        threads: int = 1,
    ) -> None:
        n = seeds.size
        days = [day_effect(participant.salt, int(v), int(s)) for v, s in zip(visits, study_seeds, strict=True)]
        self.counters = brain.seed_streams(seeds, np.full(n, participant.salt, dtype=np.uint64))
        self._brain_constants = brain.constants_of(participant, np.array([day.log_gain for day in days]))
        self._symptom_constants = symptoms.constants_of(participant, n)
        self._brain = brain.initial_state(self.counters, self._brain_constants, lead_amplitude)
        self._symptoms = symptoms.initial_state(participant, n, lead_amplitude)
        self._sos = brain.beta_filter()
        self._medication = np.stack([_medication(participant, day, float(h), periods) for day, h in zip(days, hours, strict=True)], axis=1)
        self._day_activity = np.array([day.activity for day in days])
        self._no_lfp = np.empty((n, 0), dtype=np.float32)
        self._slices = [slice(part[0], part[-1] + 1) for part in np.array_split(np.arange(n), min(threads, n))]
        self._pool = ThreadPoolExecutor(len(self._slices)) if len(self._slices) > 1 else None
        self.period = 0
        start = np.full(n, lead_amplitude)
        for _ in range(SETTLE_STEPS):
            self._step(0, start, 1.0, self._no_lfp)

    def advance(self, amplitude: Floats, *, moving: bool = False, lfp: NDArray[np.float32] | None = None) -> dict[str, Floats]:
        """Run one period of 2 s under `amplitude` [N]; `moving` while the hand is tested; `lfp` [N, 500] receives mV.

        Returns:
            `beta` (uV), `medication`, `activity`, `brady`, `tremor`, `overload`, each [N].
        """
        out = self._step(self.period, amplitude, GRASP_GAIN if moving else 1.0, self._no_lfp if lfp is None else lfp)
        self.period += 1
        return out

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _step(self, period: int, amplitude: Floats, gain: float, lfp: NDArray[np.float32]) -> dict[str, Floats]:
        n = self.counters.shape[0]
        amplitude = np.ascontiguousarray(amplitude, dtype=np.float64)
        medication = self._medication[period]
        beta, brady, activity = np.empty(n), np.empty(n), np.empty(n)

        def part(s: slice) -> None:
            counters, brain_state = self.counters[s], self._brain[s]
            constants = self._brain_constants[s]
            brain.advance(brain_state, counters, constants, amplitude[s], medication[s], gain, self._sos, beta[s], lfp[s])
            activity[s] = brain_state[:, brain.ACT] + self._day_activity[s]
            own = self._symptom_constants[s]
            symptoms.advance(self._symptoms[s], counters, own, amplitude[s], medication[s], activity[s], beta[s], brady[s])

        _for_all(part, self._slices, self._pool)
        return {
            "beta": beta,
            "medication": medication.copy(),
            "activity": activity,
            "brady": brady,
            "tremor": self._symptoms[:, symptoms.TREMOR].copy(),
            "overload": self._symptoms[:, symptoms.OVERLOAD].copy(),
        }


def run_sessions(
    participant: ParticipantModel | str,
    controller: Controller,
    *,
    visits: ArrayLike = 1,
    hours: ArrayLike = 0.5,
    seeds: ArrayLike,
    steps: int,
    lead_steps: int = 10,
    bound: Bound = DEFAULT_BOUND,
    lead_amplitude: float = 1.0,
    resolution_ma: float | None = None,
    study_seed: ArrayLike = 0,
    name: str = "rl",
    keep_lfp: bool = False,
    threads: int = 1,
    report: Report = silent,
) -> SessionBatch:
    """Run N sessions of one participant under one controller.

    Args:
        participant: a model or its code.
        controller: a policy, `random` (a new uniform draw on [bound, 1] at each step), `cdbs`, `no_dbs`, or a design's amplitudes,
            [T].
        visits, hours, seeds, study_seed: of each session, [N] or one for all; `hours` since the first session of the day (0-6).
        steps: T. lead_steps: L, beta amplitudes before step 0, which is also the window W that a policy sees.
        lead_amplitude: amplitude fraction before the session; 1 because cDBS runs between sessions.
        resolution_ma: round delivered amplitudes to this step of the device (0.1 mA for RC+S); None leaves them as asked.
        name: controller name of sessions run by a policy.
        keep_lfp: keep the LFP (2 kB per step and session).

    Raises:
        ValueError: an unknown participant or controller, no step, or a policy that leaves [0, 1] or answers in another shape. Also a design
            of another length or below `bound`.
    """
    model = _model(participant)
    if isinstance(controller, np.ndarray) and (controller.shape != (steps,) or not bool(np.all((controller >= bound) & (controller <= 1)))):
        raise ValueError(f"a design needs {steps} amplitudes from {bound:g} to 1, not {controller.shape} from {controller.min():g}")
    if steps < 1 or lead_steps < 1:
        raise ValueError(f"a session needs at least one step and one beta amplitude before it, not steps={steps}, lead_steps={lead_steps}")
    seed = np.atleast_1d(np.asarray(seeds)).astype(np.uint64)
    n = seed.size
    visit = np.broadcast_to(np.asarray(visits, dtype=np.int64), n)
    hour = np.broadcast_to(np.asarray(hours, dtype=np.float64), n)
    study = np.broadcast_to(np.asarray(study_seed, dtype=np.int64), n)
    total = lead_steps + steps
    simulation = Simulation(
        model,
        visits=visit,
        hours=hour,
        seeds=seed,
        study_seeds=study,
        periods=total,
        lead_amplitude=lead_amplitude,
        threads=threads,
    )
    choose = chooser(controller, simulation.counters, bound)
    deliver = delivery(model, resolution_ma, bound if is_random(controller) else Bound(0.0))
    beta, amplitude = np.empty((n, total)), np.full((n, total), lead_amplitude)
    hidden = {key: np.empty((n, steps)) for key in ("medication", "activity", "brady", "tremor", "overload")}
    lfp = np.empty((n, total * SAMPLES_PER_PERIOD), dtype=np.float32) if keep_lfp else None
    buffer = np.empty((n, SAMPLES_PER_PERIOD), dtype=np.float32) if keep_lfp else None
    try:
        for k in range(total):
            if k >= lead_steps:
                amplitude[:, k] = deliver(choose(beta[:, k - lead_steps : k]))
            out = simulation.advance(amplitude[:, k], moving=k >= max(total - GRASP_TEST_STEPS, lead_steps), lfp=buffer)
            beta[:, k] = out["beta"]
            if k >= lead_steps:
                for key, values in hidden.items():
                    values[:, k - lead_steps] = out[key]
            if lfp is not None and buffer is not None:
                lfp[:, k * SAMPLES_PER_PERIOD : (k + 1) * SAMPLES_PER_PERIOD] = buffer
            report((k + 1) / total)
    finally:
        simulation.close()
    amplitude = np.ascontiguousarray(amplitude[:, lead_steps:])
    outcomes = tuple(
        measure(model, simulation.counters[i], amplitude[i], hidden["brady"][i], hidden["tremor"][i], hidden["overload"][i])
        for i in range(n)
    )
    return SessionBatch(
        participant=model,
        controller=controller if isinstance(controller, str) else "random" if is_random(controller) else name,
        visits=np.array(visit),
        hours=np.array(hour),
        seeds=seed,
        lead_beta=np.ascontiguousarray(beta[:, :lead_steps]),
        beta=np.ascontiguousarray(beta[:, lead_steps:]),
        amplitude=amplitude,
        lead_amplitude=lead_amplitude,
        bound=bound if is_random(controller) else None,
        lfp=lfp,
        outcomes=outcomes,
        hidden=hidden,
    )


def run_session(
    participant: ParticipantModel | str,
    controller: Controller,
    *,
    visit: int = 1,
    hour: float = 0.5,
    seed: int,
    steps: int,
    lead_steps: int = 10,
    bound: Bound = DEFAULT_BOUND,
    resolution_ma: float | None = None,
    study_seed: int = 0,
    name: str = "rl",
) -> SimulatedSession:
    """Run one session with its LFP; arguments and errors as in `run_sessions`."""
    return run_sessions(
        participant,
        controller,
        visits=visit,
        hours=hour,
        seeds=[seed],
        steps=steps,
        lead_steps=lead_steps,
        bound=bound,
        resolution_ma=resolution_ma,
        study_seed=study_seed,
        name=name,
        keep_lfp=True,
    ).session(0)


def _model(participant: ParticipantModel | str) -> ParticipantModel:
    if isinstance(participant, ParticipantModel):
        return participant
    if participant not in PARTICIPANTS:
        raise ValueError(f"there is no synthetic participant {participant!r}; there are {', '.join(PARTICIPANTS)}")
    return PARTICIPANTS[participant]


def _medication(participant: ParticipantModel, day: DayEffect, hour: float, periods: int) -> Floats:
    hours: Floats = hour + np.arange(periods, dtype=np.float64) * (PERIOD_S / 3600.0)
    return effect(participant.regimen, hours, day.dose_factor, day.delay_h)


def _for_all(work: Callable[[slice], None], parts: Sequence[slice], pool: ThreadPoolExecutor | None) -> None:
    if pool is None:
        for part in parts:
            work(part)
        return
    results: list[Any] = [pool.submit(work, part) for part in parts]
    for result in results:
        result.result()


def session_table_csv(session: SimulatedSession) -> bytes:
    """Write columns `t_s,beta,amplitude_fraction`, one row per 2 s; beta in uV.

    Row t_s = 2(k + 1) holds step k; rows with t_s <= 0 are the window before the session, the newest at 0.
    """
    lines = ["t_s,beta,amplitude_fraction"]
    lead = session.lead_beta.size
    for i, beta in enumerate(session.lead_beta):
        lines.append(f"{PERIOD_S * (i - lead + 1):g},{float(beta)!r},{session.lead_amplitude!r}")
    for k, (beta, amplitude) in enumerate(zip(session.beta, session.amplitude, strict=True)):
        lines.append(f"{PERIOD_S * (k + 1):g},{float(beta)!r},{float(amplitude)!r}")
    return ("\n".join(lines) + "\n").encode()
