"""Sessions of a virtual patient: their days, their noise, and the loop with a controller. All sessions of a call advance together.

A session depends on its own seeds alone, so it is the same alone and among thousands. Two controllers with one seed get the same day and
the same noise: differences of true returns have small errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ml.policies.policy import Policy, start_sessions
from ml.population.virtual import _kernel, equations
from ml.population.virtual.equations import CONSTANTS, GAIN, HALF, HOUR, LEVEL, NEED, NOISES, NORMALS, STATES, U_BOUT, UNIFORMS
from ml.population.virtual.patient import HYSTERESIS, OSCILLATOR, TOLERANCE, Patient, measured_qocs, minute_means
from ml.qoc import Qoc

Floats = NDArray[np.float64]
Symptom = Literal["brady", "tremor", "overload"]

WARM_STEPS: Final = 30
"""Steps under cDBS before step 0; the last of them are the session's lead."""

HOURS_OF_A_VISIT: Final = 2.0
OWN_NORMALS: Final = 5
"""Normals of a session: its level, its first drift and activity, and the two errors of `measured_qocs`."""

_DAY_STREAM, _NORMAL_STREAM, _OWN_STREAM, _UNIFORM_STREAM, _BOUT_STREAM = 1, 2, 3, 4, 5


@dataclass(frozen=True)
class Days:
    """On which days sessions take place.

    Attributes:
        effects: standard normals of the day of each session (level, gain, half, need), [n, 4]. hours: of the visit, [n].
        change: 1 from a patient's lasting change on, 0 before it, [n].
    """

    effects: Floats
    hours: Floats
    change: Floats

    def select(self, sessions: slice | NDArray[np.int64]) -> Days:
        """Return the days of some of the sessions."""
        return Days(self.effects[sessions], self.hours[sessions], self.change[sessions])


def new_days(key: int, first: int, n: int) -> Days:
    """Draw a day of its own for each of the sessions first ... first + n - 1, at a uniform hour of a visit, after any change."""
    drawn = [_stream(key, _DAY_STREAM, i) for i in range(first, first + n)]
    return Days(np.stack([g.standard_normal(4) for g in drawn]), np.array([g.uniform(0, HOURS_OF_A_VISIT) for g in drawn]), np.ones(n))


def visit_days(key: int, visits: NDArray[np.int64], hours: Floats, change: Floats | None = None) -> Days:
    """Draw the days of numbered visits, [n]; sessions of one visit share its day. All are after any change where `change` is None."""
    effects = {int(v): _stream(key, _DAY_STREAM, -int(v)).standard_normal(4) for v in np.unique(visits)}
    after = np.ones(len(visits)) if change is None else change
    return Days(np.stack([effects[int(v)] for v in visits]), np.asarray(hours, dtype=np.float64), after)


@dataclass(frozen=True)
class Sessions:
    """Courses and results of n sessions.

    Attributes:
        lead: beta before step 0 under cDBS, [n, W]. beta, amplitude: [n, T]. brady, tremor, overload: symptoms, [n, T].
        qocs: measured outcomes by `Outcome.field`, [n] each.
    """

    lead: Floats
    beta: Floats
    amplitude: Floats
    brady: Floats
    tremor: Floats
    overload: Floats
    qocs: Mapping[str, Floats]

    def qoc(self, i: int) -> Qoc:
        """Return the QoCs of session i."""
        return Qoc.from_numbers({name: float(values[i]) for name, values in self.qocs.items()})

    def by_minute(self, symptom: Symptom) -> Floats:
        """Average a symptom over each minute, [n, M]; the last minute may be shorter. The QoCs of the session follow from these."""
        return minute_means({"brady": self.brady, "tremor": self.tremor, "overload": self.overload}[symptom])[0]


def simulate(
    patient: Patient,
    xi: float,
    controller: Policy | Floats,
    *,
    days: Days,
    key: int,
    first: int = 0,
    steps: int = 300,
    window: int = 10,
    readable: bool = False,
) -> Sessions:
    """Run sessions.

    Args:
        patient: who. xi: beta threshold, the unit of the burden of beta.
        controller: a policy, or the amplitudes of every session, [n, steps].
        days: of the n sessions. key: of the patient's streams; session i has number first + i.
        steps: T. window: W, at most `WARM_STEPS`.
        readable: run the equations in plain arrays instead of the compiled kernel (slow, the same numbers).

    Raises:
        ValueError: amplitudes outside [0, 1] or of another shape, or a window longer than the warm-up.
    """
    n, length = len(days.hours), WARM_STEPS + steps
    if window > WARM_STEPS:
        raise ValueError(f"a window of {window} steps is longer than the {WARM_STEPS} steps before a session")
    if isinstance(controller, np.ndarray) and controller.shape != (n, steps):
        raise ValueError(f"{n} sessions of {steps} steps need amplitudes of shape {(n, steps)}, not {controller.shape}")
    noise, own = _noise(key, first, n, length)
    beginning = _draw_bouts(patient, key, first, noise)
    constants = session_constants(patient, days, own)
    state = _start(patient, constants, own)
    state[:, equations.BOUT] = beginning * (patient.bout_in + patient.bout_out) < patient.bout_in
    amplitude = np.ones((n, length))
    beta, brady, tremor, overload = (np.empty((n, length)) for _ in range(4))
    controller = controller if isinstance(controller, np.ndarray) else start_sessions(controller)
    for k in range(length):
        if k >= WARM_STEPS:
            t = k - WARM_STEPS
            asked = controller[:, t] if isinstance(controller, np.ndarray) else controller.act(beta[:, k - window : k])
            amplitude[:, k] = _check_answer(np.asarray(asked, dtype=np.float64), n)
        if readable:
            equations.step(patient, xi, constants, state, amplitude, k, noise, (beta, brady, tremor, overload))
        else:
            _kernel.advance(patient, xi, constants, state, amplitude, k, noise, beta, brady, tremor, overload)
    lead, of_run = beta[:, WARM_STEPS - window : WARM_STEPS], (slice(None), slice(WARM_STEPS, None))
    run, symptoms = (beta[of_run], amplitude[of_run]), (brady[of_run], tremor[of_run], overload[of_run])
    return Sessions(lead, *run, *symptoms, measured_qocs(patient, own[:, -2:], run[1], *symptoms))


def session_constants(patient: Patient, days: Days, own: Floats) -> Floats:
    """Compute the constants of each session, [n, CONSTANTS], from the day's normals and the session's own, [n, >= 1]."""
    result = np.empty((len(own), CONSTANTS))
    result[:, LEVEL] = patient.day_level * days.effects[:, 0] + patient.session_level * own[:, 0]
    result[:, GAIN] = np.exp(patient.day_gain * days.effects[:, 1] + patient.change_gain * days.change)
    result[:, HALF] = np.exp(patient.day_half * days.effects[:, 2] + patient.change_half * days.change)
    result[:, NEED] = patient.day_need * days.effects[:, 3]
    result[:, HOUR] = days.hours
    return result


def _stream(key: int, stream: int, number: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=np.array([(key << 8) + stream, number % 2**64], dtype=np.uint64)))


def _noise(key: int, first: int, n: int, length: int) -> tuple[Floats, Floats]:
    """Draw the noise of every step, [n, K, NOISES], and each session's own normals, [n, OWN_NORMALS]."""
    # A stream for each kind: a longer session's noise then only goes on where a shorter one's ends, so length does not change beginnings.
    noise, own = np.empty((n, length, NOISES)), np.empty((n, OWN_NORMALS))
    for i in range(n):
        noise[i, :, :NORMALS] = _stream(key, _NORMAL_STREAM, first + i).standard_normal((length, NORMALS))
        own[i] = _stream(key, _OWN_STREAM, first + i).standard_normal(OWN_NORMALS)
        noise[i, :, NORMALS : NORMALS + UNIFORMS] = _stream(key, _UNIFORM_STREAM, first + i).random((length, UNIFORMS))
    return noise, own


def _draw_bouts(patient: Patient, key: int, first: int, noise: Floats) -> Floats:
    """Fill in the uniform numbers by which bouts begin and end, and return those of the state before step 0, [n]; 1 without bouts."""
    drawn = np.ones((len(noise), noise.shape[1] + 1))
    for i in range(len(noise) if patient.bout_in > 0 else 0):
        drawn[i] = _stream(key, _BOUT_STREAM, first + i).random(drawn.shape[1])
    noise[:, :, U_BOUT] = drawn[:, 1:]
    return np.asarray(drawn[:, 0])


def _start(patient: Patient, constants: Floats, own: Floats) -> Floats:
    """State under lasting cDBS, with drift and activity from their stationary distributions."""
    state = np.zeros((len(own), STATES))
    ones = np.ones(len(own))
    full = equations.dose(patient.shape, ones, patient.half * constants[:, HALF], patient.steep)
    relief = equations.dose(patient.sym_shape, ones, patient.sym_half * constants[:, HALF], patient.sym_steep)
    for column, value in (
        (equations.E_FAST, full),
        (equations.E_SLOW, full),
        (equations.S_FAST, relief),
        (equations.S_SLOW, relief),
        (equations.DRIFT, patient.drift_sd * own[:, 1]),
        (equations.ACT, own[:, 2]),
        (equations.BURDEN, 0.9 * ones),
    ):
        state[:, column] = value
    # the mechanism's own state: the size of the oscillation; the play operator and the habit where full stimulation leaves them
    at_rest: dict[int, float | Floats] = {OSCILLATOR: math.sqrt(patient.osc_base), HYSTERESIS: 1.0 - patient.play, TOLERANCE: full}
    state[:, equations.MECHANISM] = at_rest.get(patient.kind, 0.0)
    return state


def _check_answer(asked: Floats, n: int) -> Floats:
    if asked.shape != (n,):
        raise ValueError(f"the controller answered with shape {asked.shape} to {n} sessions; it must give one amplitude for each")
    if not bool(np.all((asked >= -1e-6) & (asked <= 1 + 1e-6))):
        raise ValueError(f"the controller asked for an amplitude fraction outside [0, 1]: {asked.min()} to {asked.max()}")
    return np.clip(asked, 0.0, 1.0)
