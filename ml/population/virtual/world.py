"""Worlds to measure evaluation and learning in: a virtual patient, the data of early visits, candidate policies, and their true returns.

There are three parts. A is to develop on, B to report on, C is run once before a release. A world depends on its part and index alone.
What is true in a world is for measuring: nothing may be fitted, chosen or tuned by it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import cycle
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ml.designs import DesignSettings, Hold, lay_out
from ml.mdp import MdpSettings, end_rewards, step_reward
from ml.outcomes import PREDICTED
from ml.policies.policy import ConstantPolicy, Policy, ProportionalPolicy
from ml.population.virtual.candidates import draw_candidates, draw_following
from ml.population.virtual.following import Worth, deal, with_change, with_worth, without_answer
from ml.population.virtual.patient import MECHANISMS, Patient, draw_patient
from ml.population.virtual.sessions import Days, Sessions, new_days, simulate, visit_days
from ml.population.virtual.traits import TRAITS, with_trait
from ml.qoc import Margins
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]
Part = Literal["A", "B", "C"]
DataDesign = Literal["paper", "stratified", "ladder"]

Population = Literal[1, 2]

PARTS: Final[dict[str, int]] = {"A": 11, "B": 23, "C": 37}
FOLLOWING_PARTS: Final[dict[str, int]] = {"A": 41, "B": 53, "C": 67}
"""Seeds of the parts of the second population."""
WORLDS_PER_PART: Final = 60
PER_OTHER_MECHANISM: Final = 4
"""Worlds of a part with each mechanism but the graded one: one ordinary, the others with traits in rotation."""
SILENT: Final = "silent"
SILENT_BETA: Final = 7
"""Graded worlds of a part whose beta hardly answers while symptoms do."""
PER_TRAIT: Final = 3
"""Graded worlds of a part with each of the other traits; the rest are ordinary."""
WITHOUT_END: Final = {1: 0.25, 2: 0.15}
"""Share of worlds without an end-of-session reward, by population: C2 to C4 are 0. Without it nothing rewards a dose that meets a need."""

STEPS, NO_DBS_STEPS, PAUSE_H = 300, 150, 10 / 60
VISITS, RANDOM_SESSIONS = 3, 4

MARGINS, ENERGY_SAVED = Margins(), 0.20
"""Margins of a responder against cDBS, and the share of energy that it saves."""

_DATA, _DATA_DAYS, _CALIBRATION = 1 << 40, 1 << 41, 1 << 42
"""First session numbers of what is not truth on new days."""


class Mean(NamedTuple):
    """A mean over simulated sessions and its standard error."""

    value: float
    standard_error: float

    @classmethod
    def of(cls, values: Floats) -> Mean:
        """Average values [n], n >= 2."""
        return cls(float(values.mean()), float(values.std(ddof=1) / math.sqrt(values.size)))


@dataclass(frozen=True, kw_only=True)
class Truth:
    """True value of a policy, by Monte Carlo.

    Attributes:
        total: E[r_end + sum over t < H of gamma^t r_t]. step_return, end_reward: its parts. energy: mean squared amplitude fraction.
        amplitude: mean fraction. beta: mean, uV. qocs: of each measured outcome, by `Outcome.field`.
        returns: total return of every session, [n]; session i of two policies has the same day and noise.
    """

    total: Mean
    step_return: Mean
    end_reward: Mean
    energy: Mean
    amplitude: Mean
    beta: Mean
    qocs: Mapping[str, Mean]
    returns: Floats

    def to_json(self) -> dict[str, Any]:
        """Return means and standard errors by name, and the standard deviation of returns between sessions."""
        named = {k: list(v) for k, v in (vars(self) | dict(self.qocs)).items() if isinstance(v, Mean)}
        return named | {"returns_sd": float(self.returns.std(ddof=1))}


@dataclass(frozen=True)
class World:
    """One virtual patient with MDP settings.

    Attributes:
        part, index: number of the world. patient: its constants. trait: what makes it difficult, `traits.TRAITS`; None for an ordinary one.
            settings: of its MDP. xi_beta is midway between beta under cDBS and under 0.3.
        worth: of following beta, as drawn (`following.Worth`); None in the first population.
        spread: standard deviation of beta, its unit. key: of its random streams.
    """

    part: str
    index: int
    patient: Patient
    trait: str | None
    settings: MdpSettings
    spread: float
    key: int
    worth: Worth | None = None

    @property
    def name(self) -> str:
        """Such as `A07-bursts`, in the second population `A07-bursts-pays`."""
        return f"{self.part}{self.index:02d}-{self.patient.mechanism}{'' if self.worth is None else f'-{self.worth}'}"

    @property
    def modelled(self) -> bool:
        """True where the mechanism of beta is of the kind that the estimators assume."""
        return self.patient.kind == 0

    def run(self, controller: Policy | Floats, days: Days, first: int, steps: int = STEPS) -> Sessions:
        """Run sessions with the numbers from `first` on."""
        s = self.settings
        return simulate(self.patient, s.xi_beta, controller, days=days, key=self.key, first=first, steps=steps, window=s.window)

    def data(self, design: DataDesign, seed: int = 0, visits: int = VISITS) -> ReplayBuffer:
        """Simulate early visits, each of two cDBS sessions, four random ones by the design, and five minutes without stimulation.

        Whatever the design, the visits have the same days and take the same minutes: the ladder, where there is one, is one of the four.
        """
        rows = visit_plan(self.settings, design, seed, visits)
        days = self.data_days(rows, seed)
        sessions = []
        for i, row in enumerate(rows):
            own = days.select(slice(i, i + 1))
            run = self.run(row.amplitudes[None, :], own, _DATA + 4096 * seed + i, row.amplitudes.size)
            bound = self.settings.bound if row.controller == "random" else None
            sessions.append(
                SessionTrajectory(
                    session_id=i + 1,
                    visit=row.visit,
                    controller=row.controller,
                    lead_beta=run.lead[0],
                    beta=run.beta[0],
                    amplitude=run.amplitude[0],
                    qoc=run.qoc(0),
                    random_bound=bound,
                    holds=row.holds,
                    medication_h=self.medication_h(row.hour),
                )
            )
        return ReplayBuffer(self.settings, tuple(sessions), "uV", "table")

    def medication_h(self, hour: float) -> float | None:
        """Compute the hours since the last dose at an hour of a visit; None of a patient who takes none. A dose works for two to four
        hours."""
        if self.patient.med_need == 0:
            return None
        works = float(np.random.default_rng([self.key, 0x3ED1]).uniform(2.0, 4.0))
        return hour - self.patient.med_off_h + works

    def data_days(self, rows: list[DataSession], seed: int) -> Days:
        """Draw the days of planned sessions."""
        visits, first = np.array([row.visit for row in rows]), self.patient.change_visit
        return visit_days(self.key, visits + 64 * seed, np.array([row.hour for row in rows]), (visits >= first).astype(np.float64))

    def truth(self, policy: Policy, sessions: int = 300) -> Truth:
        """Estimate the true return on new days, each session on a day of its own."""
        return _truth(self.settings, self.run(policy, new_days(self.key, 0, sessions), 0))

    def truth_on_data_days(self, policy: Policy, sessions: int = 300, seed: int = 0, visits: int = VISITS) -> Truth:
        """Estimate what the policy would have returned on the very days of `data(.., seed, visits)`, with other noise."""
        days = self.data_days(visit_plan(self.settings, "paper", seed, visits), seed)
        of = np.arange(sessions) % len(days.hours)
        return _truth(self.settings, self.run(policy, days.select(of), _DATA_DAYS))

    def candidates(self) -> dict[str, Policy]:
        """Draw the policies to be evaluated, the same ones whatever the data are."""
        rng = np.random.default_rng([self.key, 0xCA4D])
        draw = draw_candidates if self.worth is None else draw_following
        return draw(rng, self.settings.xi_beta, self.spread, self.settings.window)


@dataclass(frozen=True)
class DataSession:
    """One session of the data: visit, controller (`cdbs`, `random`, `no_dbs`), hour of the visit, amplitude of every step, sustained
    draws."""

    visit: int
    controller: str
    hour: float
    amplitudes: Floats
    holds: tuple[Hold, ...] = ()


def visit_plan(settings: MdpSettings, design: DataDesign, seed: int, visits: int) -> list[DataSession]:
    """List the sessions of early visits in their order."""
    designed = lay_out(
        DesignSettings(
            name="paper" if design == "paper" else "stratified",
            visits=visits,
            sessions=RANDOM_SESSIONS,
            steps=STEPS,
            period_s=settings.period_s,
            bound=settings.bound,
            ladder=design == "ladder",
            seed=seed,
        )
    )
    rows: list[DataSession] = []
    for visit in range(1, visits + 1):
        random = [("random", s.amplitudes, s.holds) for s in designed if s.visit == visit]
        nothing: tuple[Hold, ...] = ()
        cdbs, off = ("cdbs", np.ones(STEPS), nothing), ("no_dbs", np.zeros(NO_DBS_STEPS), nothing)
        slots = [cdbs, *random[:2], cdbs, *random[2:], off]
        rows += [DataSession(visit, name, k * (STEPS * 2 / 3600 + PAUSE_H), a, holds) for k, (name, a, holds) in enumerate(slots)]
    return rows


@lru_cache(maxsize=256)
def world(part: Part, index: int, population: Population = 1) -> World:
    """Build world `index` of a part; the second population has the axis *worth of following beta* (`following`).

    Raises:
        ValueError: no such part, or an index outside it.
    """
    if part not in PARTS or not 0 <= index < WORLDS_PER_PART:
        raise ValueError(f"there is no world {index} in part {part!r}: parts are A, B and C, indices 0 to {WORLDS_PER_PART - 1}")
    seed = (PARTS if population == 1 else FOLLOWING_PARTS)[part]
    kind, trait = make_up(part, population)[index]
    rng = np.random.default_rng([seed, index, 0x776F])
    patient, worth = with_trait(draw_patient(kind, rng), trait, rng), None
    if population == 2:
        dealt = deal(seed, WORLDS_PER_PART)[index]
        patient, worth = with_worth(patient, dealt.worth, rng), dealt.worth
        patient = with_change(patient, rng) if dealt.changes else patient
        patient = patient if dealt.answers else without_answer(patient)
    bound = float(rng.choice((0.3, 0.3, 0.3, 0.4)))
    weight = 0.0 if rng.random() < WITHOUT_END[population] else 10.0
    key = seed * 1000 + index
    days = replace(new_days(key, _CALIBRATION, 100), change=np.zeros(100))
    full, low = (simulate(patient, 1.0, ConstantPolicy(a), days=days, key=key, first=_CALIBRATION).beta for a in (1.0, 0.3))
    settings = MdpSettings(xi_beta=float(full.mean() + low.mean()) / 2, c2=weight, c3=weight, c4=weight, lower_bound=bound)
    return World(part, index, patient, trait, settings, float(np.concatenate([full, low]).std()), key, worth)


def make_up(part: str, population: Population = 1) -> list[tuple[int, str | None]]:
    """List mechanism and trait of every world of a part: the same numbers of each in every part, in an order of its own."""
    traits = [t for t in TRAITS if t != SILENT]
    rotation = cycle(traits)
    others: list[tuple[int, str | None]] = []
    for kind in range(1, len(MECHANISMS)):
        others += [(kind, None), *((kind, next(rotation)) for _ in range(PER_OTHER_MECHANISM - 1))]
    repeated = [SILENT] * SILENT_BETA + [t for t in traits for _ in range(PER_TRAIT)]
    difficult: list[tuple[int, str | None]] = [(0, t) for t in repeated]
    ordinary: list[tuple[int, str | None]] = [(0, None)] * (WORLDS_PER_PART - len(others) - len(difficult))
    both = others + difficult + ordinary
    return [both[i] for i in np.random.default_rng([(PARTS if population == 1 else FOLLOWING_PARTS)[part], 0x6D65]).permutation(len(both))]


def _truth(settings: MdpSettings, run: Sessions) -> Truth:
    discount = settings.gamma ** np.arange(run.beta.shape[1])
    steps = (step_reward(settings, run.beta, run.amplitude) * discount).sum(axis=1)
    ends = end_rewards(settings, run.qocs)
    return Truth(
        total=Mean.of(steps + ends),
        step_return=Mean.of(steps),
        end_reward=Mean.of(ends),
        energy=Mean.of((run.amplitude**2).mean(axis=1)),
        amplitude=Mean.of(run.amplitude.mean(axis=1)),
        beta=Mean.of(run.beta.mean(axis=1)),
        qocs={name: Mean.of(values) for name, values in run.qocs.items()},
        returns=steps + ends,
    )


def within_margins(policy: Truth, cdbs: Truth) -> bool:
    """Decide whether no predicted outcome is truly worse than under cDBS by more than its margin."""
    return all(o.slack(policy.qocs[o.field].value, cdbs.qocs[o.field].value, MARGINS.of(o)) >= 0 for o, _ in PREDICTED)


def simple_policies(settings: MdpSettings, spread: float) -> dict[str, Policy]:
    """Build constants and proportional controllers that decide who is a responder."""
    constants: dict[str, Policy] = {f"constant {a:.2f}": ConstantPolicy(a) for a in (0.4, 0.5, 0.6, 0.7, 0.8, 0.89)}
    xi = settings.xi_beta
    return constants | {
        f"proportional {floor:.1f}": ProportionalPolicy(xi - 0.7 * spread, xi + 0.7 * spread, floor, settings.window)
        for floor in (0.3, 0.5, 0.7)
    }


def is_responder(truths: Mapping[str, Truth], cdbs: Truth) -> bool:
    """Decide whether one of these policies is truly within the margins and saves `ENERGY_SAVED` of the energy of cDBS."""
    return any(t.energy.value <= (1 - ENERGY_SAVED) * cdbs.energy.value and within_margins(t, cdbs) for t in truths.values())
