"""Worth of following beta: the axis of the second population, with lasting changes and symptoms that do not answer.

Need that comes in bouts (movement, a burst of symptoms) is hidden. Beta shows a part of it. Where it *pays*, beta rises with need, and what
a bout asks for is too much between bouts. Where it *hurts*, beta falls in bouts, as it does in movement: who follows it gives least when
most is needed. With *none*, need does not vary within a session. Sizes are assumed, as everywhere in this population.

The labels say how a patient was drawn. Whether following truly pays is measured (`worth_of_following`), for it depends on everything else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from ml.policies.policy import ConstantPolicy, Policy, ProportionalPolicy
from ml.population.virtual.candidates import RelayPolicy
from ml.population.virtual.patient import HILL, THRESHOLD, Patient, drawn_rate

Floats = NDArray[np.float64]
Worth = Literal["pays", "none", "hurts"]

PAYS, HURTS = 0.65, 0.15
"""Shares of worlds drawn with each worth; the others have none."""
CHANGED, UNANSWERED = 0.1, 0.1
"""Shares of worlds whose response changes between visits, and whose symptoms do not answer."""
CHANGE_VISITS = (2, 3)
LEAST_GAIN: Final = 0.05
"""Gain of the best closed loop over the best constant of no more energy, share of the range of true returns, from which following pays."""


@dataclass(frozen=True)
class Dealt:
    """Properties of one world that are dealt out over a part."""

    worth: Worth
    changes: bool
    answers: bool


def deal(seed: int, worlds: int) -> list[Dealt]:
    """Assign worths, changes and unanswered symptoms to the worlds of a part: fixed numbers, independent orders."""
    pays, hurts = round(PAYS * worlds), round(HURTS * worlds)
    numbers: dict[Worth, int] = {"pays": pays, "hurts": hurts, "none": worlds - pays - hurts}
    worths = [worth for worth, number in numbers.items() for _ in range(number)]
    rng = np.random.default_rng([seed, 0xF0110])
    order, changed, unanswered = (rng.permutation(worlds) for _ in range(3))
    changes, silent = set(changed[: round(CHANGED * worlds)].tolist()), set(unanswered[: round(UNANSWERED * worlds)].tolist())
    return [Dealt(worths[order[i]], i in changes, i not in silent) for i in range(worlds)]


def with_worth(patient: Patient, worth: Worth, rng: np.random.Generator) -> Patient:
    """Give a patient bouts of need that beta shows, hides or reverses; or a need that does not vary within a session."""

    def uniform(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    drawn: dict[str, Any] = {
        "bout_out": drawn_rate(rng, 40.0, 180.0),
        "bout_beta": uniform(0.4, 1.0),
        "bout_half": uniform(0.5, 1.0),
        "bout_need": uniform(0.1, 0.4),
        "bout_tolerance": uniform(0.3, 0.6),
        "sym_half": uniform(0.25, 0.45),
        "sym_steep": uniform(3.5, 6.5),
        "sym_fast": uniform(0.6, 0.95),
        "sym_fast_up": drawn_rate(rng, 4.0, 12.0),
        "sym_fast_down": drawn_rate(rng, 4.0, 20.0),
        "side": uniform(0.6, 1.6),
        "tolerance": uniform(0.15, 0.4),
    }
    duty = uniform(0.2, 0.5)
    drawn["bout_in"] = drawn["bout_out"] * duty / (1 - duty)
    steady = patient._replace(act_half=0.0, act_need=0.0, act_tolerance=0.0)
    if worth == "none":
        return steady
    shape = HILL if rng.random() < 0.5 else THRESHOLD
    if worth == "hurts":
        return steady._replace(**drawn | {"bout_beta": -drawn["bout_beta"]}, sym_shape=shape)
    return patient._replace(**drawn, sym_shape=shape)


def with_change(patient: Patient, rng: np.random.Generator) -> Patient:
    """Change a patient's response for good from the second or third visit on: less effect of any dose, and more needed for the same."""
    gain, half = float(np.log(rng.uniform(0.3, 0.6))), float(rng.uniform(0.2, 0.5))
    return patient._replace(change_visit=int(rng.choice(CHANGE_VISITS)), change_gain=gain, change_half=half)


def without_answer(patient: Patient) -> Patient:
    """Make symptoms constant whatever the stimulation; beta may answer all the same."""
    return patient._replace(answers=0.0, burden_share=0.0, side=0.0)


def closed_loops(xi: float, spread: float, window: int) -> dict[str, Policy]:
    """Build closed loops that span what following beta can do: proportional and dual-threshold ones, by level, range and smoothing."""
    found: dict[str, Policy] = {}
    for level in (-0.6, 0.0, 0.6):
        centre, width = xi + level * spread, 0.6 * spread
        for floor in (0.3, 0.5, 0.7):
            for newest in (3, window):
                found[f"proportional {level} {floor} {newest}"] = ProportionalPolicy(centre - width, centre + width, floor, newest)
        for floor, ceiling in ((0.3, 0.6), (0.3, 0.8), (0.3, 1.0), (0.5, 0.75), (0.5, 1.0), (0.7, 1.0)):
            found[f"dual {level} {floor} {ceiling}"] = RelayPolicy(centre - 0.2 * spread, centre + 0.2 * spread, floor, ceiling)
    return found


@dataclass(frozen=True)
class FollowingWorth:
    """Measured worth of following beta, in points of the return.

    Attributes:
        closed: true return of the best closed loop. constant: of the best constant of no more energy. any_constant: of the best one.
        loop: name of the closed loop. range: of true returns over all of them.
    """

    closed: float
    constant: float
    any_constant: float
    loop: str
    range: float

    @property
    def pays(self) -> bool:
        """True where following beta is worth `LEAST_GAIN` of the range or more."""
        return self.closed - self.constant >= LEAST_GAIN * self.range


def worth_of_following(
    value_and_energy: Callable[[Policy], tuple[float, float]], loops: dict[str, Policy], amplitudes: Floats | None = None
) -> FollowingWorth:
    """Compare the best closed loop with the best constant of no more energy.

    Args:
        value_and_energy: true return of a policy, and its energy (mean squared amplitude fraction). loops: closed loops.
        amplitudes: of the constants, rising, [n]; between them returns are linear in energy.
    """
    grid = np.arange(0.3, 1.001, 0.05) if amplitudes is None else amplitudes
    constants = np.array([value_and_energy(ConstantPolicy(float(min(a, 1.0))))[0] for a in grid])
    best_so_far = np.maximum.accumulate(constants)
    found = {name: value_and_energy(policy) for name, policy in loops.items()}
    gains = {name: value - float(np.interp(energy, grid**2, best_so_far)) for name, (value, energy) in found.items()}
    best = max(found, key=lambda name: found[name][0])
    everything = np.append(constants, [value for value, _ in found.values()])
    return FollowingWorth(found[best][0], found[best][0] - gains[best], float(constants.max()), best, float(np.ptp(everything)))
