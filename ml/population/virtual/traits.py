"""Eight traits that make a virtual patient difficult. Each follows a way in which evaluation has failed on patients it had not seen.

A trait changes constants of a patient whatever its mechanism. Sizes are assumed; docs/population.md argues for each why it is plausible.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from ml.population.virtual.patient import HILL, LATE_RATING, PEAK_END_RATING, THRESHOLD, U_SHAPE, Patient, drawn_rate, faint_outcomes

Changes = dict[str, Any]


class _Draws:
    """Uniform numbers and log-uniform time constants of one generator."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def __call__(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def rate(self, low_s: float, high_s: float) -> float:
        return drawn_rate(self.rng, low_s, high_s)

    def one_of(self, *values: int) -> int:
        return int(self.rng.choice(values))


def _saturating(_: Patient, u: _Draws) -> Changes:
    """Make a middle dose do all that a high one does, and a slightly lower one do nothing."""
    shape = u.one_of(HILL, THRESHOLD)
    half = u(0.25, 0.55)
    return {
        "shape": shape,
        "half": half,
        "steep": u(4.0, 8.0),
        "sym_shape": u.one_of(HILL, THRESHOLD),
        "sym_half": half + u(-0.05, 0.15),
        "sym_steep": u(4.0, 8.0),
        "depth": u(0.25, 0.5),
    }


def _drifting(_: Patient, u: _Draws) -> Changes:
    """Make beta answer at once, and wander without cause over minutes, further than stimulation moves it."""
    immediate = u(0.8, 1.0)
    return {
        "immediate": immediate,
        "fast": 1.0 - immediate,
        "depth": u(0.25, 0.5),
        "drift_rate": u.rate(150.0, 900.0),
        "drift_sd": u(0.2, 0.45),
        "noise": u(0.06, 0.15),
    }


def _overstimulating(_: Patient, u: _Draws) -> Changes:
    """Make full amplitude more than is good: the answer of beta turns round, and side effects are felt."""
    best = u(0.5, 0.75)
    return {
        "shape": U_SHAPE,
        "half": best,
        "sym_shape": U_SHAPE,
        "sym_half": best + u(0.0, 0.15),
        "side": u(1.0, 3.0),
        "tolerance": u(0.3, 0.7),
    }


def _unsteady(_: Patient, u: _Draws) -> Changes:
    """Make days and sessions move the level of beta, the dose response and the symptoms."""
    return {
        "day_level": u(0.08, 0.2),
        "day_gain": u(0.2, 0.4),
        "day_half": u(0.15, 0.3),
        "day_need": u(0.1, 0.25),
        "session_level": u(0.1, 0.2),
    }


def _silent(_: Patient, u: _Draws) -> Changes:
    """Make beta hardly answer to stimulation while symptoms do: beta cannot steer."""
    return {"depth": u(0.01, 0.04), "burden_share": 0.0}


def _faint(p: Patient, u: _Draws) -> Changes:
    """Make effects small against noise, of beta and of what is asked and measured at the end."""
    return {
        "depth": u(0.1, 0.25),
        "noise": u(0.15, 0.3),
        "ar": u(0.3, 0.8),
        "session_level": u(0.05, 0.15),
        **faint_outcomes(p, u),
    }


def _asymmetric(_: Patient, u: _Draws) -> Changes:
    """Make effects come much faster than they go, or the reverse. Changing doses then leave another effect than lasting ones of the same
    mean."""
    slow = u(0.6, 0.95)
    immediate = (1 - slow) * u(0.0, 1.0)
    quick, late = (u.rate(8.0, 30.0), u.rate(10.0, 40.0)), (u.rate(200.0, 900.0), u.rate(300.0, 1200.0))
    up, down = (quick, late) if u(0.0, 1.0) < 0.7 else (late, quick)
    return {
        "immediate": immediate,
        "fast": 1 - slow - immediate,
        "slow_up": up[0],
        "slow_down": down[0],
        "sym_fast": u(0.1, 0.4),
        "sym_slow_up": up[1],
        "sym_slow_down": down[1],
        "rating_form": u.one_of(LATE_RATING, PEAK_END_RATING),
    }


def _artefact(p: Patient, u: _Draws) -> Changes:
    """Make stimulation leak into the sensed beta at once, while it lowers beta itself over seconds and, for the larger part, minutes."""
    return {"leak": u(0.25, 0.5), "depth": max(p.depth, u(0.5, 0.8)), "immediate": 0.0, "fast": u(0.05, 0.4)}


TRAITS: Final[dict[str, Callable[[Patient, _Draws], Changes]]] = {
    "saturating": _saturating,
    "drifting": _drifting,
    "overstimulated": _overstimulating,
    "unsteady": _unsteady,
    "silent": _silent,
    "faint": _faint,
    "asymmetric": _asymmetric,
    "artefact": _artefact,
}
"""By name, what a trait changes of a patient."""


SECOND: Final = 0.4
"""Share of the patients with a trait that have a second one."""


def with_trait(patient: Patient, trait: str | None, rng: np.random.Generator) -> Patient:
    """Give a patient a trait, and with a share of `SECOND` a further one, which the first overrides; None leaves it ordinary.

    Unsteady days are no difficulty by themselves while all doses keep their order, so they always come with another trait.

    Raises:
        ValueError: there is no such trait.
    """
    if trait is None:
        return patient
    if trait not in TRAITS:
        raise ValueError(f"there is no trait {trait!r}; there are {', '.join(TRAITS)}")
    further = rng.choice([t for t in TRAITS if t not in (trait, "silent")])
    if trait == "unsteady" or rng.random() < SECOND:
        patient = patient._replace(**TRAITS[further](patient, _Draws(rng)))
    return patient._replace(**TRAITS[trait](patient, _Draws(rng)))
