"""A virtual patient: the constants of one world at beta level (steps of 2 s), and the distribution that they are drawn from.

All sizes are assumed; nothing here is fitted to a person. `equations`, which is written to be read, shows what the constants do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PERIOD_S: Final = 2.0

MECHANISMS: Final = ("graded", "bursts", "volatility", "hysteresis", "delayed", "regimes", "tolerance", "oscillator")
"""How stimulation reaches beta. All but the first are outside what the estimators of `ml.ope` can represent."""

SHAPES: Final = ("line", "hill", "threshold", "u")
TREMORS: Final = ("none", "graded", "episodic")
RATINGS: Final = ("mean", "late", "peak_end")
"""What a rating goes by: the whole session, its last two minutes, or its worst and its last minute."""

BURSTS, VOLATILITY, HYSTERESIS, DELAYED, REGIMES, TOLERANCE, OSCILLATOR = range(1, 8)
LINE, HILL, THRESHOLD, U_SHAPE = range(4)
NO_TREMOR, GRADED_TREMOR, EPISODIC_TREMOR = range(3)
MEAN_RATING, LATE_RATING, PEAK_END_RATING = range(3)

STEPS_PER_MINUTE, GRASP_STEPS, LATE_STEPS = 30, 5, 60
MILD = 1.0
"""Mean severity of a minute from which its tremor counts as mild."""


class Patient(NamedTuple):
    """Constants of one virtual patient. Rates are shares per step of 2 s, levels and depths are in log beta (or shares of `unit`).

    Attributes:
        kind: index into `MECHANISMS`. log_scale: 1 where beta = unit exp(x), 0 where beta = unit max(1 + x, 0.05).
        unit: size of beta, uV.
        shape, half, steep: static dose response of beta, `SHAPES`; for the U `half` is the best amplitude.
        depth: fall of x at full effect. immediate, fast: shares of the effect at once and within seconds; the rest is slow.
        fast_up, fast_down, slow_up, slow_down: rates of wash-in and wash-out.
        drift_rate, drift_sd: hidden slow state. act_rate, act_beta, act_half: hidden activity, its effect on x and on
        log half (active, more stimulation is needed for the same effect: the larger part of what following beta can better).
        ar, noise, noise_slope: noise around x, and how its size changes with amplitude (log per unit).
        ring_gain, ring_decay, ring_turn: ringing at changes of amplitude; decay per step and angle per step (rad).
        delay: dead time, steps. rebound, rebound_decay: overshoot after a fall of amplitude. play: width of the hysteresis.
        regime_rate, regime_gain, regime_level: how often the second regime begins or ends, its gain and its level.
        habit, habit_rate: share of the effect that wears off, and how fast. burst_jump, burst_in, burst_out: bistable beta.
        vol_rate, vol_sd, vol_dose: log volatility, and how far the effect shrinks fluctuations. osc_base, osc_drop: growth rate of the
        oscillation without stimulation, and how far the effect lowers it.
        med_off_h: hour of the visit at which medication wears off. med_beta, med_need: what it takes from x and from the symptoms' need.
        day_level, day_gain, day_half, day_need: standard deviations between days, of x, log depth, log half, need. session_level: of x.
        sym_shape, sym_half, sym_steep, sym_fast, sym_fast_up, sym_fast_down, sym_slow_up, sym_slow_down: the symptoms' own dose response.
        burden_share: share of bradykinesia that follows beta. act_need, act_tolerance: how activity moves need and tolerance, the part of
        the treatment that following beta can better.
        tremor, tremor_max, tremor_theta, tremor_up, tremor_down, tremor_noise, onset: tremor form `TREMORS`, size, rates, onset per step.
        leak: share by which stimulation at full amplitude raises the beta that is sensed, not the beta that there is (artefact).
        grasp_low, grasp_high, grasp_noise: Hz at most and least bradykinesia, error of a test. side, tolerance: over-stimulation.
        rating_form: `RATINGS`. rating_top, rating_scale, rating_noise: rating without symptoms, how far symptoms lower it, its error.
        bout_in, bout_out: chance per step that a bout of need (movement, a burst of symptoms) begins or ends. bout_beta, bout_half,
        bout_need, bout_tolerance: what a bout adds to x, log half, need and tolerance (`following`).
        answers: share of the symptoms' relief that follows stimulation; the rest is constant.
        change_visit: first visit of a lasting change, 0 for none. change_gain, change_half: what it adds to log depth and log half.
    """

    kind: int
    log_scale: int
    unit: float
    shape: int
    half: float
    steep: float
    depth: float
    immediate: float
    fast: float
    fast_up: float
    fast_down: float
    slow_up: float
    slow_down: float
    drift_rate: float
    drift_sd: float
    act_rate: float
    act_beta: float
    act_half: float
    ar: float
    noise: float
    noise_slope: float
    ring_gain: float
    ring_decay: float
    ring_turn: float
    delay: int
    rebound: float
    rebound_decay: float
    play: float
    regime_rate: float
    regime_gain: float
    regime_level: float
    habit: float
    habit_rate: float
    burst_jump: float
    burst_in: float
    burst_out: float
    vol_rate: float
    vol_sd: float
    vol_dose: float
    osc_base: float
    osc_drop: float
    med_off_h: float
    med_beta: float
    med_need: float
    day_level: float
    day_gain: float
    day_half: float
    day_need: float
    session_level: float
    sym_shape: int
    sym_half: float
    sym_steep: float
    sym_fast: float
    sym_fast_up: float
    sym_fast_down: float
    sym_slow_up: float
    sym_slow_down: float
    burden_share: float
    act_need: float
    act_tolerance: float
    tremor: int
    tremor_max: float
    tremor_theta: float
    tremor_up: float
    tremor_down: float
    tremor_noise: float
    onset: float
    leak: float
    grasp_low: float
    grasp_high: float
    grasp_noise: float
    side: float
    tolerance: float
    rating_form: int
    rating_top: float
    rating_scale: float
    rating_noise: float
    bout_in: float = 0.0
    bout_out: float = 1.0
    bout_beta: float = 0.0
    bout_half: float = 0.0
    bout_need: float = 0.0
    bout_tolerance: float = 0.0
    answers: float = 1.0
    change_visit: int = 0
    change_gain: float = 0.0
    change_half: float = 0.0

    @property
    def mechanism(self) -> str:
        """Name of the mechanism."""
        return MECHANISMS[self.kind]

    @property
    def beta_answers(self) -> bool:
        """True where beta answers to stimulation at all; where it does not, symptoms may."""
        return self.depth >= 0.1


def rate(tau_s: float) -> float:
    """Compute the share of the way to its target that a first-order lag goes in one step."""
    return 1.0 - math.exp(-PERIOD_S / tau_s)


def drawn_rate(rng: np.random.Generator, low_s: float, high_s: float) -> float:
    """Draw the rate of a lag whose time constant is log-uniform between two numbers of seconds."""
    return rate(math.exp(float(rng.uniform(math.log(low_s), math.log(high_s)))))


def draw_patient(kind: int, rng: np.random.Generator) -> Patient:
    """Draw an ordinary patient of one mechanism; `traits.with_trait` makes it a difficult one.

    Args:
        kind: index into `MECHANISMS`. rng: what the constants are drawn with.

    Raises:
        ValueError: there is no such mechanism.
    """
    if not 0 <= kind < len(MECHANISMS):
        raise ValueError(f"there are {len(MECHANISMS)} mechanisms, so number {kind} is none of them")

    def uniform(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def tau(low_s: float, high_s: float) -> float:
        return drawn_rate(rng, low_s, high_s)

    def pick(*weights: float) -> int:
        return int(rng.choice(len(weights), p=np.array(weights) / sum(weights)))

    shape = pick(0.2, 0.35, 0.25, 0.2)
    shares = rng.dirichlet((1.0, 1.0, 1.2))
    follow = uniform(0.1, 1.0) if rng.random() < 0.7 else 0.0
    marginal = rng.random() < 0.25  # cDBS is hardly enough: lowering it costs at once
    tremor = pick(0.25, 0.5, 0.25)
    medicated = rng.random() < 0.6
    day = uniform(0.1, 0.6)
    return Patient(
        kind=kind,
        log_scale=int(rng.random() < 0.65),
        unit=uniform(0.5, 3.0),
        shape=shape,
        half=uniform(0.55, 0.8) if shape == U_SHAPE else uniform(0.3, 0.7),
        steep=uniform(1.5, 5.0),
        depth=uniform(0.35, 0.8),
        immediate=float(shares[0]),
        fast=float(shares[1]),
        fast_up=tau(2.0, 15.0),
        fast_down=tau(4.0, 40.0),
        slow_up=tau(40.0, 240.0),
        slow_down=tau(60.0, 600.0),
        drift_rate=tau(60.0, 600.0),
        drift_sd=uniform(0.0, 0.15),
        act_rate=tau(60.0, 240.0),
        act_beta=uniform(0.1, 0.35) * (0.3 + follow),
        act_half=uniform(0.15, 0.6) * follow,
        ar=uniform(0.0, 0.6),
        noise=uniform(0.06, 0.22),
        noise_slope=uniform(-0.8, 0.4),
        ring_gain=uniform(0.05, 0.4) * (rng.random() < 0.3),
        ring_decay=uniform(0.4, 0.85),
        ring_turn=uniform(0.6, 2.6),
        delay=int(rng.integers(5, 21)) if kind == DELAYED else 0,
        rebound=uniform(0.1, 0.5),
        rebound_decay=1.0 - tau(10.0, 60.0),
        play=uniform(0.12, 0.3),
        regime_rate=tau(60.0, 240.0),
        regime_gain=uniform(-0.6, 0.3),
        regime_level=uniform(-0.3, 0.3),
        habit=uniform(0.6, 1.2),
        habit_rate=tau(60.0, 240.0),
        burst_jump=uniform(0.5, 1.0),
        burst_in=uniform(0.08, 0.25),
        burst_out=uniform(0.05, 0.15),
        vol_rate=tau(20.0, 120.0),
        vol_sd=uniform(0.3, 0.7),
        vol_dose=uniform(0.4, 0.75),
        osc_base=uniform(0.6, 1.4),
        osc_drop=uniform(0.8, 1.8),
        med_off_h=uniform(0.5, 2.0) if medicated else 100.0,
        med_beta=uniform(0.03, 0.2) if medicated else 0.0,
        med_need=uniform(0.05, 0.3) if medicated else 0.0,
        day_level=0.08 * day,
        day_gain=0.15 * day,
        day_half=0.1 * day,
        day_need=0.1 * day,
        session_level=uniform(0.02, 0.1),
        sym_shape=THRESHOLD if marginal else pick(0.2, 0.45, 0.35),
        sym_half=uniform(0.8, 0.95) if marginal else uniform(0.3, 0.65),
        sym_steep=uniform(4.0, 7.0) if marginal else uniform(1.5, 5.0),
        sym_fast=uniform(0.2, 0.9),
        sym_fast_up=tau(4.0, 20.0),
        sym_fast_down=tau(6.0, 40.0),
        sym_slow_up=tau(60.0, 240.0),
        sym_slow_down=tau(120.0, 600.0),
        burden_share=uniform(0.1, 0.7),
        act_need=0.5 * follow * uniform(0.4, 1.0),
        act_tolerance=0.5 * follow * uniform(0.4, 1.0),
        tremor=tremor,
        tremor_max=uniform(1.5, 4.5),
        tremor_theta=uniform(0.4, 0.75),
        tremor_up=tau(6.0, 25.0),
        tremor_down=tau(4.0, 12.0),
        tremor_noise=uniform(0.02, 0.1),
        onset=PERIOD_S / uniform(90.0, 300.0),
        leak=0.0,
        grasp_low=uniform(1.1, 1.7),
        grasp_high=uniform(2.2, 3.0),
        grasp_noise=uniform(0.08, 0.2),
        side=uniform(0.3, 2.0) if rng.random() < 0.6 else 0.0,
        tolerance=uniform(0.5, 1.0),
        rating_form=pick(0.5, 0.25, 0.25),
        rating_top=uniform(7.5, 9.8),
        rating_scale=uniform(0.5, 1.1),
        rating_noise=uniform(0.3, 0.8),
    )


def faint_outcomes(patient: Patient, uniform: Callable[[float, float], float]) -> dict[str, Any]:
    """Draw constants with which outcomes answer less to symptoms and vary more, as changes of a patient."""
    return {
        "grasp_low": patient.grasp_high - uniform(0.3, 0.6),
        "grasp_noise": uniform(0.15, 0.3),
        "rating_scale": uniform(0.3, 0.6),
        "rating_noise": uniform(0.7, 1.2),
    }


def minute_means(values: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Average values of every step [n, T] over minutes, [n, M], and count the steps of each minute, [M]."""
    starts = np.arange(0, values.shape[1], STEPS_PER_MINUTE)
    lengths = np.diff(np.append(starts, values.shape[1]))
    return np.asarray(np.add.reduceat(values, starts, axis=1) / lengths), lengths


def measured_qocs(patient: Patient, noise: Floats, amplitude: Floats, brady: Floats, tremor: Floats, overload: Floats) -> dict[str, Floats]:
    """Compute the measured outcomes of sessions by `Outcome.field`, [n] each.

    Args:
        noise: standard normals, errors of grasp and rating, [n, 2].
        amplitude, brady, tremor, overload: amplitude fraction and symptoms, [n, T].
    """
    late = brady[:, -GRASP_STEPS:].mean(axis=1)
    grasp = patient.grasp_high - (patient.grasp_high - patient.grasp_low) * late + patient.grasp_noise * noise[:, 0]
    complaint = 3.0 * brady + 4.0 * np.minimum(tremor / 2.5, 1.0) + 3.0 * patient.side * overload
    felt = _rated_complaint(patient.rating_form, complaint, minute_means(complaint)[0])
    felt += np.abs(np.diff(amplitude, axis=1)).mean(axis=1)
    score = patient.rating_top - patient.rating_scale * felt + patient.rating_noise * noise[:, 1]
    of_minute, lengths = minute_means(tremor)
    counted = of_minute >= MILD
    return {
        "grasp_hz": np.clip(grasp, 0.1, 4.5),
        "rating": np.clip(np.round(score), 1, 10),
        "tremor_percent": 100 * (counted @ lengths) / tremor.shape[1],
    }


def _rated_complaint(form: int, complaint: Floats, minutes: Floats) -> Floats:
    """Summarise the complaint that a rating follows, [n], from that of every step, [n, T], and of every minute, [n, M]; see
    `RATINGS`."""
    if form == LATE_RATING:
        return np.asarray(complaint[:, -LATE_STEPS:].mean(axis=1))
    if form == PEAK_END_RATING:
        return np.asarray((minutes.max(axis=1) + minutes[:, -1]) / 2)
    return np.asarray(complaint.mean(axis=1))
