"""The equations of `equations`, compiled: one step of n sessions in one pass. `tests/ml/population` holds the two equal."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from ml.population.virtual.equations import (
    ACT,
    BOUT,
    BURDEN,
    BURDEN_RATE,
    BURST_OUT_GAIN,
    DRIFT,
    E_FAST,
    E_SLOW,
    EPISODE,
    EPISODE_END,
    EPISODE_SEVERITY,
    GAIN,
    HALF,
    HOUR,
    LEVEL,
    MECHANISM,
    MEDICATION_WIDTH_H,
    MODE,
    NEED,
    NOISE,
    RING,
    RING_BEFORE,
    S_FAST,
    S_SLOW,
    TREMOR,
    U_BOUT,
    U_EPISODE,
    U_MODE,
    UNANSWERED_RELIEF,
    Z_ACT,
    Z_DRIFT,
    Z_NOISE,
    Z_OTHER,
    Z_TREMOR,
)  # fmt: skip
from ml.population.virtual.patient import (
    BURSTS,
    DELAYED,
    EPISODIC_TREMOR,
    GRADED_TREMOR,
    HILL,
    HYSTERESIS,
    LINE,
    OSCILLATOR,
    PERIOD_S,
    REGIMES,
    THRESHOLD,
    TOLERANCE,
    VOLATILITY,
    Patient,
)  # fmt: skip

Floats = NDArray[np.float64]


@numba.njit(cache=True, inline="always")
def _dose(shape: int, a: float, half: float, steep: float) -> float:
    if shape == LINE:
        return a
    if shape == HILL:
        return (1 + half**steep) * a**steep / (half**steep + a**steep)
    if shape == THRESHOLD:
        at = 1 / (1 + math.exp(-3 * steep * (a - half)))
        none = 1 / (1 + math.exp(3 * steep * half))
        full = 1 / (1 + math.exp(-3 * steep * (1 - half)))
        return (at - none) / (full - none)
    return max(1 - ((a - half) / half) ** 2, 0.0)


@numba.njit(cache=True, inline="always")
def _towards(value: float, target: float, up: float, down: float) -> float:
    gap = target - value
    return value + (up if gap > 0 else down) * gap


@numba.njit(cache=True)
def advance(
    p: Patient,
    xi: float,
    constants: Floats,
    state: Floats,
    amplitude: Floats,
    k: int,
    noise: Floats,
    out_beta: Floats,
    out_brady: Floats,
    out_tremor: Floats,
    out_overload: Floats,
) -> None:
    """Run `equations.step`, with its four outputs named."""
    drift_size, act_size = p.drift_sd * math.sqrt(2 * p.drift_rate), math.sqrt(2 * p.act_rate)
    ring_1, ring_2 = 2 * p.ring_decay * math.cos(p.ring_turn), p.ring_decay**2
    for i in range(len(state)):
        s, c, z = state[i], constants[i], noise[i, k]
        a, before = amplitude[i, k], amplitude[i, max(k - 1, 0)]
        m = 1 / (1 + math.exp((c[HOUR] + k * PERIOD_S / 3600 - p.med_off_h) / MEDICATION_WIDTH_H))
        s[DRIFT] += -p.drift_rate * s[DRIFT] + drift_size * z[Z_DRIFT]
        s[ACT] += -p.act_rate * s[ACT] + act_size * z[Z_ACT]
        ring = ring_1 * s[RING] - ring_2 * s[RING_BEFORE] + p.ring_gain * (a - before)
        s[RING_BEFORE] = s[RING]
        s[RING] = ring
        if p.bout_in > 0 and z[U_BOUT] < (p.bout_out if s[BOUT] > 0.5 else p.bout_in):
            s[BOUT] = 1.0 - s[BOUT]
        x = c[LEVEL] + p.act_beta * s[ACT] + s[DRIFT] - p.med_beta * m + ring
        x += p.bout_beta * s[BOUT]
        reached = amplitude[i, max(k - p.delay, 0)]
        if p.kind == HYSTERESIS:
            s[MECHANISM] = min(max(s[MECHANISM], a - p.play), a + p.play)
            reached = min(max(s[MECHANISM], 0.0), 1.0)
        moved = c[HALF] * math.exp(p.act_half * s[ACT] + p.bout_half * s[BOUT])
        d = _dose(p.shape, reached, p.half * moved, p.steep)
        s[E_FAST] = _towards(s[E_FAST], d, p.fast_up, p.fast_down)
        s[E_SLOW] = _towards(s[E_SLOW], d, p.slow_up, p.slow_down)
        effect = p.immediate * d + p.fast * s[E_FAST] + (1 - p.immediate - p.fast) * s[E_SLOW]
        depth = p.depth * c[GAIN]
        s[NOISE] = p.ar * s[NOISE] + p.noise * math.exp(p.noise_slope * (a - 0.65)) * z[Z_NOISE]
        bounded = min(max(effect, 0.0), 1.0)
        if p.kind == OSCILLATOR:
            r = s[MECHANISM]
            growth = p.osc_base - p.osc_drop * effect * depth / p.depth
            s[MECHANISM] = min(abs(r + 0.25 * (growth * r - r**3) + s[NOISE]), 2.5)
            beta = p.unit * (0.3 + s[MECHANISM]) * math.exp(x)
        else:
            if p.kind == BURSTS:
                chance = p.burst_out + BURST_OUT_GAIN * bounded if s[MODE] > 0.5 else p.burst_in * (1 - bounded)
                if z[U_MODE] < chance:
                    s[MODE] = 1.0 - s[MODE]
                x += -0.2 * depth * effect + p.burst_jump * s[MODE] + s[NOISE]
            elif p.kind == VOLATILITY:
                s[MECHANISM] += -p.vol_rate * s[MECHANISM] + p.vol_sd * math.sqrt(2 * p.vol_rate) * z[Z_OTHER]
                x += -0.25 * depth * effect + 2 * s[NOISE] * math.exp(s[MECHANISM]) * (1 - p.vol_dose * bounded)
            elif p.kind == DELAYED:
                fall = max(amplitude[i, max(k - 1 - p.delay, 0)] - reached, 0.0)
                s[MECHANISM] = p.rebound_decay * s[MECHANISM] + p.rebound * fall
                x += -depth * effect + s[MECHANISM] + s[NOISE]
            elif p.kind == REGIMES:
                if z[U_MODE] < p.regime_rate:
                    s[MODE] = 1.0 - s[MODE]
                gain = p.regime_gain if s[MODE] > 0.5 else 1.0
                x += -depth * gain * effect + p.regime_level * s[MODE] + s[NOISE]
            elif p.kind == TOLERANCE:
                s[MECHANISM] += p.habit_rate * (1 + 2 * d) * (d - s[MECHANISM])
                x += -depth * (effect - p.habit * s[MECHANISM]) + s[NOISE]
            else:
                x += -depth * effect + s[NOISE]
            beta = p.unit * (math.exp(min(x, 3.0)) if p.log_scale else max(1 + x, 0.05))

        sym = _dose(p.sym_shape, a, p.sym_half * moved, p.sym_steep)
        s[S_FAST] = _towards(s[S_FAST], sym, p.sym_fast_up, p.sym_fast_down)
        s[S_SLOW] = _towards(s[S_SLOW], sym, p.sym_slow_up, p.sym_slow_down)
        constant = (1 - p.answers) * UNANSWERED_RELIEF
        relief = p.answers * (p.sym_fast * s[S_FAST] + (1 - p.sym_fast) * s[S_SLOW]) + constant
        need = c[NEED] + p.act_need * s[ACT] - p.med_need * m + p.bout_need * s[BOUT]
        s[BURDEN] += BURDEN_RATE * (beta / xi - s[BURDEN])
        burden = min(max((s[BURDEN] - 0.6) / 0.8, -0.5), 1.5)
        if p.tremor == GRADED_TREMOR:
            share = min(max((p.tremor_theta + need - 0.95 * (p.answers * s[S_FAST] + constant)) / p.tremor_theta, 0.0), 1.3)
            s[TREMOR] = _towards(s[TREMOR], p.tremor_max * share, p.tremor_up, p.tremor_down)
            s[TREMOR] = max(s[TREMOR] + p.tremor_noise * z[Z_TREMOR], 0.0)
        elif p.tremor == EPISODIC_TREMOR:
            chance = EPISODE_END if s[EPISODE] > 0.5 else p.onset * min(max(1.3 - relief + need, 0.02), 3.0)
            if z[U_EPISODE] < chance:
                s[EPISODE] = 1.0 - s[EPISODE]
            s[TREMOR] = EPISODE_SEVERITY * s[EPISODE]
        out_beta[i, k] = beta * (1 + p.leak * a)
        out_brady[i, k] = p.burden_share * burden + (1 - p.burden_share) * (1 - relief) + 0.5 * need
        out_tremor[i, k] = s[TREMOR]
        tolerated = p.tolerance + p.act_tolerance * s[ACT] + p.bout_tolerance * s[BOUT]
        out_overload[i, k] = max(a**2 * (1 + 0.3 * m) - tolerated, 0.0)
