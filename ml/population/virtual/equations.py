"""One step of virtual patients in plain arrays: the equations, to be read. The compiled twin in `_kernel` gives the same numbers.

With a the amplitude in force, D the static dose response and every lag first order with its own rates up and down:

D's half-effect amplitude is half exp(day + act_half act): active, more stimulation is needed.

    graded       x = level + act_beta act + drift - med_beta m - depth (i D + f E_fast + (1 - i - f) E_slow) + ring + noise
    bursts       x = ... - depth E / 5 + burst_jump q;  q enters with p = burst_in (1 - E), leaves with p = burst_out + 0.45 E
    volatility   x = ... - depth E / 4 + noise exp(v) (1 - vol_dose E);  v an Ornstein-Uhlenbeck process
    hysteresis   D of the play operator p_k = min(max(p_{k-1}, a - play), a + play), not of a
    delayed      D of a `delay` steps ago, plus a rebound that jumps when that amplitude falls
    regimes      depth times 1 or regime_gain (may be negative), level 0 or regime_level, by a two-state Markov chain
    tolerance    E less habit H;  H follows D at habit_rate (1 + 2 D): the answer to a lasting dose wears off, or turns round
    oscillator   r <- |r + (mu r - r^3) / 4 + noise|, mu = osc_base - osc_drop E;  beta = unit (0.3 + r) exp(rest of x)

Noise is an autoregression whose size is noise exp(noise_slope (a - 0.65)). Ringing is a damped second-order answer to changes of a.
Sensed beta is beta (1 + leak a): an artefact, which symptoms do not feel.

In a bout of need (a two-state Markov chain q, `following`) bout_beta is added to x, bout_half to log half, bout_need to n, bout_tolerance
to the tolerance. Where symptoms do not answer, S is constant.

Symptoms have their own dose response S (fast and slow) and a need n = day + act_need act - med_need m + bout_need q:

    bradykinesia = burden_share b + (1 - burden_share)(1 - S) + 0.5 n,   b from beta's low-pass of 60 s over the threshold
    tremor, graded: T to tremor_max clip((theta + n - 0.95 S_fast) / theta, 0, 1.3)
    tremor, episodic: begins with p = onset clip(1.3 - S + n), ends at 1/45 s
    over-stimulation = max(0, a^2 (1 + 0.3 m) - tolerance - act_tolerance act - bout_tolerance q)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.population.virtual.patient import (
    BURSTS,
    DELAYED,
    EPISODIC_TREMOR,
    GRADED_TREMOR,
    HILL,
    HYSTERESIS,
    LINE,
    NO_TREMOR,
    OSCILLATOR,
    PERIOD_S,
    REGIMES,
    THRESHOLD,
    TOLERANCE,
    VOLATILITY,
    Patient,
)  # fmt: skip

Floats = NDArray[np.float64]

# columns of the constants of a session
LEVEL, GAIN, HALF, NEED, HOUR = range(5)
CONSTANTS = 5
# columns of the state of a session
E_FAST, E_SLOW, DRIFT, ACT, NOISE, RING, RING_BEFORE, MODE, MECHANISM, S_FAST, S_SLOW, TREMOR, BURDEN, EPISODE, BOUT = range(15)
STATES = 15
# columns of the noise of a step
Z_NOISE, Z_DRIFT, Z_ACT, Z_OTHER, Z_TREMOR, U_MODE, U_EPISODE, U_BOUT = range(8)
NOISES, NORMALS, UNIFORMS = 8, 5, 2

BURDEN_RATE = 1.0 - np.exp(-PERIOD_S / 60.0)
EPISODE_END = PERIOD_S / 45.0
EPISODE_SEVERITY = 2.0
BURST_OUT_GAIN = 0.45
MEDICATION_WIDTH_H = 0.25
UNANSWERED_RELIEF = 0.5
"""Relief of symptoms that do not answer."""


def dose(shape: int, a: Floats, half: Floats, steep: float) -> Floats:
    """Compute the static dose response, 0 without stimulation; 1 at full amplitude, or for the U at the amplitude `half`. Any shape of
    arrays."""
    if shape == LINE:
        return a
    if shape == HILL:
        return (1 + half**steep) * a**steep / (half**steep + a**steep)
    if shape == THRESHOLD:
        at, none, full = (1 / (1 + np.exp(-3 * steep * (x - half))) for x in (a, 0 * a, 1 + 0 * a))
        return np.asarray((at - none) / (full - none))
    return np.maximum(1 - ((a - half) / half) ** 2, 0.0)


def medication(p: Patient, constants: Floats, step: int) -> Floats:
    """Compute the effect of medication, 0 to 1, wearing off around `med_off_h`."""
    hour = constants[:, HOUR] + step * PERIOD_S / 3600
    return np.asarray(1 / (1 + np.exp((hour - p.med_off_h) / MEDICATION_WIDTH_H)))


def moved_half(p: Patient, constants: Floats, state: Floats) -> Floats:
    """Compute the factor on the half-effect amplitudes of the day and the moment's activity, [n]."""
    return np.asarray(constants[:, HALF] * np.exp(p.act_half * state[:, ACT] + p.bout_half * state[:, BOUT]))


def step(
    p: Patient, xi: float, constants: Floats, state: Floats, amplitude: Floats, k: int, noise: Floats, out: tuple[Floats, ...]
) -> None:
    """Advance n sessions by step k, in place.

    Args:
        p: the patient. xi: threshold of beta, the unit of the burden. constants: [n, CONSTANTS]. state: [n, STATES].
        amplitude: [n, K], known up to column k. noise: [n, K, NOISES]. out: beta, bradykinesia, tremor, over-stimulation, [n, K] each.
    """
    z = noise[:, k]
    a = amplitude[:, k]
    before = amplitude[:, max(k - 1, 0)]
    m = medication(p, constants, k)
    state[:, DRIFT] += -p.drift_rate * state[:, DRIFT] + p.drift_sd * np.sqrt(2 * p.drift_rate) * z[:, Z_DRIFT]
    state[:, ACT] += -p.act_rate * state[:, ACT] + np.sqrt(2 * p.act_rate) * z[:, Z_ACT]
    if p.bout_in > 0:
        in_bout = state[:, BOUT] > 0.5
        state[:, BOUT] = np.where(z[:, U_BOUT] < np.where(in_bout, p.bout_out, p.bout_in), 1.0 - state[:, BOUT], state[:, BOUT])
    x = constants[:, LEVEL] + p.act_beta * state[:, ACT] + state[:, DRIFT] - p.med_beta * m + _ringing(p, state, a - before)
    x += p.bout_beta * state[:, BOUT]

    reached = _reaching_dose(p, state, amplitude, k)
    d = dose(p.shape, reached, p.half * moved_half(p, constants, state), p.steep)
    _towards(state, E_FAST, d, p.fast_up, p.fast_down)
    _towards(state, E_SLOW, d, p.slow_up, p.slow_down)
    effect = p.immediate * d + p.fast * state[:, E_FAST] + (1 - p.immediate - p.fast) * state[:, E_SLOW]
    depth = p.depth * constants[:, GAIN]
    size = p.noise * np.exp(p.noise_slope * (a - 0.65))
    state[:, NOISE] = p.ar * state[:, NOISE] + size * z[:, Z_NOISE]
    beta = _beta(p, state, x, effect, depth, d, z, before_delay=_delayed_amplitude(p, amplitude, k - 1), reached=reached)
    out[0][:, k] = beta * (1 + p.leak * a)
    _symptoms(p, xi, constants, state, a, m, beta, z, k, out)


def _ringing(p: Patient, state: Floats, change: Floats) -> Floats:
    ring = 2 * p.ring_decay * np.cos(p.ring_turn) * state[:, RING] - p.ring_decay**2 * state[:, RING_BEFORE] + p.ring_gain * change
    state[:, RING_BEFORE] = state[:, RING]
    state[:, RING] = ring
    return np.asarray(ring)


def _delayed_amplitude(p: Patient, amplitude: Floats, k: int) -> Floats:
    return amplitude[:, max(k - p.delay, 0)]


def _reaching_dose(p: Patient, state: Floats, amplitude: Floats, k: int) -> Floats:
    """Compute the amplitude that acts now: behind a play operator, a dead time, or at once."""
    if p.kind == HYSTERESIS:
        a = amplitude[:, k]
        state[:, MECHANISM] = np.minimum(np.maximum(state[:, MECHANISM], a - p.play), a + p.play)
        return np.clip(state[:, MECHANISM], 0.0, 1.0)
    return _delayed_amplitude(p, amplitude, k)


def _beta(
    p: Patient, state: Floats, x: Floats, effect: Floats, depth: Floats, d: Floats, z: Floats, *, before_delay: Floats, reached: Floats
) -> Floats:
    """Compute beta of the step by the patient's mechanism, [n]."""
    bounded = np.clip(effect, 0.0, 1.0)
    if p.kind == BURSTS:
        high = state[:, MODE] > 0.5
        chance = np.where(high, p.burst_out + BURST_OUT_GAIN * bounded, p.burst_in * (1 - bounded))
        state[:, MODE] = np.where(z[:, U_MODE] < chance, 1.0 - state[:, MODE], state[:, MODE])
        return _scale_beta(p, x - 0.2 * depth * effect + p.burst_jump * state[:, MODE] + state[:, NOISE])
    if p.kind == VOLATILITY:
        state[:, MECHANISM] += -p.vol_rate * state[:, MECHANISM] + p.vol_sd * np.sqrt(2 * p.vol_rate) * z[:, Z_OTHER]
        return _scale_beta(p, x - 0.25 * depth * effect + 2 * state[:, NOISE] * np.exp(state[:, MECHANISM]) * (1 - p.vol_dose * bounded))
    if p.kind == DELAYED:
        state[:, MECHANISM] = p.rebound_decay * state[:, MECHANISM] + p.rebound * np.maximum(before_delay - reached, 0.0)
        return _scale_beta(p, x - depth * effect + state[:, MECHANISM] + state[:, NOISE])
    if p.kind == REGIMES:
        state[:, MODE] = np.where(z[:, U_MODE] < p.regime_rate, 1.0 - state[:, MODE], state[:, MODE])
        gain = np.where(state[:, MODE] > 0.5, p.regime_gain, 1.0)
        return _scale_beta(p, x - depth * gain * effect + p.regime_level * state[:, MODE] + state[:, NOISE])
    if p.kind == TOLERANCE:
        state[:, MECHANISM] += p.habit_rate * (1 + 2 * d) * (d - state[:, MECHANISM])
        return _scale_beta(p, x - depth * (effect - p.habit * state[:, MECHANISM]) + state[:, NOISE])
    if p.kind == OSCILLATOR:
        r, growth = state[:, MECHANISM], p.osc_base - p.osc_drop * effect * depth / p.depth
        state[:, MECHANISM] = np.minimum(np.abs(r + 0.25 * (growth * r - r**3) + state[:, NOISE]), 2.5)
        return np.asarray(p.unit * (0.3 + state[:, MECHANISM]) * np.exp(x))
    return _scale_beta(p, x - depth * effect + state[:, NOISE])


def _scale_beta(p: Patient, x: Floats) -> Floats:
    return np.asarray(p.unit * (np.exp(np.minimum(x, 3.0)) if p.log_scale else np.maximum(1 + x, 0.05)))


def _symptoms(
    p: Patient, xi: float, constants: Floats, state: Floats, a: Floats, m: Floats, beta: Floats, z: Floats, k: int, out: tuple[Floats, ...]
) -> None:
    s = dose(p.sym_shape, a, p.sym_half * moved_half(p, constants, state), p.sym_steep)
    _towards(state, S_FAST, s, p.sym_fast_up, p.sym_fast_down)
    _towards(state, S_SLOW, s, p.sym_slow_up, p.sym_slow_down)
    constant = (1 - p.answers) * UNANSWERED_RELIEF
    fast = p.answers * state[:, S_FAST] + constant
    effect = p.answers * (p.sym_fast * state[:, S_FAST] + (1 - p.sym_fast) * state[:, S_SLOW]) + constant
    need = constants[:, NEED] + p.act_need * state[:, ACT] - p.med_need * m + p.bout_need * state[:, BOUT]
    state[:, BURDEN] += BURDEN_RATE * (beta / xi - state[:, BURDEN])
    burden = np.clip((state[:, BURDEN] - 0.6) / 0.8, -0.5, 1.5)
    if p.tremor == GRADED_TREMOR:
        target = p.tremor_max * np.clip((p.tremor_theta + need - 0.95 * fast) / p.tremor_theta, 0.0, 1.3)
        _towards(state, TREMOR, target, p.tremor_up, p.tremor_down)
        state[:, TREMOR] = np.maximum(state[:, TREMOR] + p.tremor_noise * z[:, Z_TREMOR], 0.0)
    elif p.tremor == EPISODIC_TREMOR:
        chance = np.where(state[:, EPISODE] > 0.5, EPISODE_END, p.onset * np.clip(1.3 - effect + need, 0.02, 3.0))
        state[:, EPISODE] = np.where(z[:, U_EPISODE] < chance, 1.0 - state[:, EPISODE], state[:, EPISODE])
        state[:, TREMOR] = EPISODE_SEVERITY * state[:, EPISODE]
    else:
        assert p.tremor == NO_TREMOR
    out[1][:, k] = p.burden_share * burden + (1 - p.burden_share) * (1 - effect) + 0.5 * need
    out[2][:, k] = state[:, TREMOR]
    tolerated = p.tolerance + p.act_tolerance * state[:, ACT] + p.bout_tolerance * state[:, BOUT]
    out[3][:, k] = np.maximum(a**2 * (1 + 0.3 * m) - tolerated, 0.0)


def _towards(state: Floats, column: int, target: Any, up: float, down: float) -> None:
    gap = target - state[:, column]
    state[:, column] += np.where(gap > 0, up, down) * gap
