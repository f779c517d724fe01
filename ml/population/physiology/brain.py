"""Beta activity of one synthetic participant: a stochastic, delayed STN-GPe mean field near its Hopf point.

Two populations, subthalamic nucleus (S) and external globus pallidus (G), in spikes per second:

    tau_S dS/dt = F_S(w_CS (Ctx + (1 - kappa E) sigma_c xi) - w_GS G(t - 6 ms)) - S
    tau_G dG/dt = F_G((1 - eta E) w_SG S(t - 6 ms) - w_GG G(t - 4 ms) - w_XG Str) - G

with the sigmoid F(x) = M / (1 + exp(-4 x / M) (M - B) / B). Weights are on the line from the healthy (K = 0) to the parkinsonian (K = 1)
set of Nevado-Holgado, Terry and Bogacz 2010 (J Neurosci 30:12340). DBS acts in two places. It removes a share eta E of the STN-GPe loop
gain. It also removes a share kappa E of the cortical fluctuations xi that reach the nucleus through the hyperdirect pathway. Its effect E
has two parts: one follows the amplitude within half a second, the other builds up over seconds and outlasts stimulation. Every population
input is delayed. So over one step of 1 ms the drive is known, and the leak is integrated exactly (exponential integrator, trapezoid in the
drive).

Each session owns its random streams: splitmix64, a counter hashed per draw, with the session's seed as key. A session's numbers therefore
depend neither on its batch, nor on threads, nor on the controller. Two policies with one seed get the same noise.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ml.compiled import compiled
from ml.population.participants import ParticipantModel

LFP_RATE_HZ: Final = 250
PERIOD_S: Final = 2.0
SAMPLES_PER_PERIOD: Final = 500
BETA_BAND_HZ: Final = (13.0, 35.0)
BETA_UNIT: Final = "uV"

# Columns of the state of one session.
_S, _G = 0, 8  # delay lines of eight 1 ms steps each
_XI, _X, _BACKGROUND, _AT_ONCE, _LASTING, _ACT, _FILTER = 16, 17, 18, 19, 20, 21, 22
STATE_SIZE: Final = 22 + 8
ACT: Final = _ACT
# Columns of the constants of one session.
_K0, _ETA, _A50, _HILL, _S_ACT, _C_MED, _S_K = range(7)
# Random streams of one session.
STREAM_CORTEX, STREAM_LFP, STREAM_SLOW, STREAM_SYMPTOMS, STREAM_OUTCOMES, STREAM_CONTROLLER = range(6)
STREAMS: Final = 6

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31, _SHIFT_11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)

# Nevado-Holgado et al. 2010: time constants and delays in ms, rates in spikes per second, weights healthy and parkinsonian.
_TAU_S, _TAU_G = 6.0, 14.0
_M_S, _B_S, _M_G, _B_G = 300.0, 17.0, 400.0, 75.0
_CORTEX, _STRIATUM = 27.0, 2.0
_W_SG, _W_GS, _W_GG, _W_CS, _W_XG = (19.0, 20.0), (1.12, 10.7), (6.60, 12.3), (2.42, 9.2), (15.1, 139.4)
_SIGMA_CORTEX, _TAU_CORTEX = 3.0, 5.0  # assumed: spikes per second and ms
_TAU_X_S, _TAU_ACT_S = 0.40, 90.0  # assumed: bursts within, and drifts over, a session
_TAU_AT_ONCE_S = 0.5  # Wiest 2020: suppressed within 0.5 s of onset; that this part ends as fast is assumed
_TAU_ON_S, _TAU_OFF_S = 2.0, 12.0  # build-up assumed; Kuehn 2008: still reduced about 12 s after cessation
_AT_ONCE_SHARE = 0.40  # assumed
_KAPPA = 0.30  # assumed size; antidromic blocking of the hyperdirect pathway: Li 2012, from general knowledge
_LFP_UV_PER_HZ, _BACKGROUND_UV, _WHITE = 0.5, 0.50, 0.3  # assumed, so that beta is 1-4 uV as in real STN recordings
_BACKGROUND_CORNER_HZ = 3.0  # assumed: 1/f^2 above

_DT = 1.0
_DECAY_S, _DECAY_G = math.exp(-_DT / _TAU_S), math.exp(-_DT / _TAU_G)
_DECAY_XI = math.exp(-_DT / _TAU_CORTEX)
_DECAY_X = math.exp(-4e-3 / _TAU_X_S)
_DECAY_BG = math.exp(-4e-3 * 2 * math.pi * _BACKGROUND_CORNER_HZ)
_DECAY_ACT = math.exp(-PERIOD_S / _TAU_ACT_S)
_GAIN_AT_ONCE = 1 - math.exp(-4e-3 / _TAU_AT_ONCE_S)
_GAIN_ON, _GAIN_OFF = 1 - math.exp(-4e-3 / _TAU_ON_S), 1 - math.exp(-4e-3 / _TAU_OFF_S)


@compiled(inline="always")
def _mix(z: Any) -> Any:
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    return z ^ (z >> _SHIFT_31)


@compiled()
def seed_streams(seeds: Any, salt: Any) -> Any:
    """Make the counters of all random streams, shape [N, STREAMS], from session seeds and the participant's salt, both uint64 of shape
    [N]."""
    counters = np.empty((seeds.shape[0], STREAMS), dtype=np.uint64)
    for i in range(seeds.shape[0]):
        for j in range(STREAMS):
            counters[i, j] = _mix(_mix(seeds[i] + _GOLDEN) ^ _mix(salt[i] + np.uint64(j + 1) * _MIX_2))
    return counters


@compiled()
def uniform(counters: Any, stream: int) -> float:
    """Draw the next number from (0, 1) of a stream; `counters` is the row of one session and is advanced in place."""
    counters[stream] += _GOLDEN
    return (float(_mix(counters[stream]) >> _SHIFT_11) + 0.5) * 1.1102230246251565e-16


@compiled()
def gauss_pair(counters: Any, stream: int) -> Any:
    """Draw the next two independent standard normals of a stream (Box and Muller)."""
    radius = math.sqrt(-2.0 * math.log(uniform(counters, stream)))
    angle = 2.0 * math.pi * uniform(counters, stream)
    return radius * math.cos(angle), radius * math.sin(angle)


@compiled(inline="always")
def _rate(x: float, maximum: float, base: float) -> float:
    return maximum / (1.0 + math.exp(-4.0 * x / maximum) * (maximum - base) / base)


@compiled()
def saturation(a: float, a50: float, hill: float) -> float:
    """Compute the share of the full DBS effect at amplitude fraction a: a Hill curve scaled to 1 at a = 1."""
    if a <= 0.0:
        return 0.0
    return (1.0 + a50**hill) * a**hill / (a**hill + a50**hill)


@compiled()
def _filter_sample(sample: float, state: Any, sos: Any) -> float:
    for j in range(sos.shape[0]):
        out = sos[j, 0] * sample + state[_FILTER + 2 * j]
        state[_FILTER + 2 * j] = sos[j, 1] * sample - sos[j, 4] * out + state[_FILTER + 2 * j + 1]
        state[_FILTER + 2 * j + 1] = sos[j, 2] * sample - sos[j, 5] * out
        sample = out
    return sample


@compiled()
def _one_period(state: Any, counters: Any, c: Any, amplitude: float, k_period: float, sos: Any, lfp: Any) -> float:
    """Advance one session by 500 LFP samples in place; returns their beta RMS in uV. `lfp` (mV) is filled where it is not empty."""
    e_inf = saturation(amplitude, c[_A50], c[_HILL])
    noise_xi = _SIGMA_CORTEX * math.sqrt(1.0 - _DECAY_XI**2)
    noise_x, noise_bg = math.sqrt(1.0 - _DECAY_X**2), math.sqrt(1.0 - _DECAY_BG**2)
    xi, x, background = state[_XI], state[_X], state[_BACKGROUND]
    at_once, lasting = state[_AT_ONCE], state[_LASTING]
    power = 0.0
    now = 0  # 500 samples of 4 steps are a multiple of the delay lines' 8: every period starts at slot 0
    for n in range(SAMPLES_PER_PERIOD):
        g_x, g_bg = gauss_pair(counters, STREAM_LFP)
        g_white, _ = gauss_pair(counters, STREAM_LFP)
        x = _DECAY_X * x + noise_x * g_x
        background = _DECAY_BG * background + noise_bg * g_bg
        at_once += (e_inf - at_once) * _GAIN_AT_ONCE
        lasting += (e_inf - lasting) * (_GAIN_ON if e_inf > lasting else _GAIN_OFF)
        e = _AT_ONCE_SHARE * at_once + (1.0 - _AT_ONCE_SHARE) * lasting
        passed = 1.0 - _KAPPA * e
        k = k_period * math.exp(c[_S_K] * x)
        w_sg = (1.0 - c[_ETA] * e) * (_W_SG[0] + k * (_W_SG[1] - _W_SG[0]))
        w_gs = _W_GS[0] + k * (_W_GS[1] - _W_GS[0])
        w_gg = _W_GG[0] + k * (_W_GG[1] - _W_GG[0])
        w_cs = _W_CS[0] + k * (_W_CS[1] - _W_CS[0])
        striatum = (_W_XG[0] + k * (_W_XG[1] - _W_XG[0])) * _STRIATUM
        spare = 0.0
        for substep in range(4):
            if substep % 2 == 0:
                draw, spare = gauss_pair(counters, STREAM_CORTEX)
            else:
                draw = spare
            xi = _DECAY_XI * xi + noise_xi * draw
            nxt = (now + 1) & 7
            s_6, g_6, g_4 = state[_S + ((now + 2) & 7)], state[_G + ((now + 2) & 7)], state[_G + ((now + 4) & 7)]
            s_5, g_5, g_3 = state[_S + ((now + 3) & 7)], state[_G + ((now + 3) & 7)], state[_G + ((now + 5) & 7)]
            drive_s = _rate(w_cs * (_CORTEX + passed * xi) - w_gs * 0.5 * (g_6 + g_5), _M_S, _B_S)
            drive_g = _rate(w_sg * 0.5 * (s_6 + s_5) - w_gg * 0.5 * (g_4 + g_3) - striatum, _M_G, _B_G)
            state[_S + nxt] = drive_s + (state[_S + now] - drive_s) * _DECAY_S
            state[_G + nxt] = drive_g + (state[_G + now] - drive_g) * _DECAY_G
            now = nxt
        sample = _LFP_UV_PER_HZ * (state[_S + now] - 15.0) + _BACKGROUND_UV * (background + _WHITE * g_white)
        if lfp.shape[0] > 0:
            lfp[n] = sample * 1e-3
        beta = _filter_sample(sample, state, sos)
        power += beta * beta
    state[_XI], state[_X], state[_BACKGROUND] = xi, x, background
    state[_AT_ONCE], state[_LASTING] = at_once, lasting
    return math.sqrt(power / SAMPLES_PER_PERIOD)


@compiled(nogil=True)
def advance(state: Any, counters: Any, constants: Any, amplitude: Any, medication: Any, gain: float, sos: Any, beta: Any, lfp: Any) -> None:
    """Advance N sessions by one period of 2 s, in place.

    Args:
        state: [N, STATE_SIZE] float64. counters: [N, STREAMS] uint64. constants: [N, 7] float64, from `constants_of`.
        amplitude: amplitude fraction in force, [N]. medication: levodopa effect 0-1, [N]. gain: factor on K (below 1 while the hand moves).
        sos: band-pass from `beta_filter`. beta: [N], receives P_beta in uV. lfp: [N, 500] float32, receives mV, or [N, 0] to skip it.
    """
    noise_act = math.sqrt(1.0 - _DECAY_ACT**2)
    for i in range(state.shape[0]):
        c = constants[i]
        draw, _ = gauss_pair(counters[i], STREAM_SLOW)
        state[i, _ACT] = _DECAY_ACT * state[i, _ACT] + noise_act * draw
        k = gain * c[_K0] * math.exp(c[_S_ACT] * state[i, _ACT]) * (1.0 - c[_C_MED] * medication[i])
        beta[i] = _one_period(state[i], counters[i], c, amplitude[i], k, sos, lfp[i])


@compiled()
def initial_state(counters: Any, constants: Any, amplitude: float) -> Any:
    """Compute the state of N sessions after a long time at one constant amplitude, shape [N, STATE_SIZE]; the fast part still has to
    settle."""
    state = np.zeros((counters.shape[0], STATE_SIZE))
    for i in range(counters.shape[0]):
        state[i, _S : _S + 8] = 15.0
        state[i, _G : _G + 8] = 60.0
        state[i, _X], state[i, _ACT] = gauss_pair(counters[i], STREAM_SLOW)
        state[i, _AT_ONCE] = state[i, _LASTING] = saturation(amplitude, constants[i, _A50], constants[i, _HILL])
    return state


def constants_of(participant: ParticipantModel, log_gain: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute constants of N sessions, shape [N, 7]; `log_gain` [N] is the day's and the visit's shift of log K."""
    p = participant.brain
    one = np.array([p.k0, p.eta, p.a50, p.hill, p.s_act, p.c_med, p.s_k])
    rows = np.repeat(one[None, :], log_gain.size, axis=0)
    rows[:, _K0] *= [math.exp(shift) for shift in log_gain]
    return rows


@cache
def beta_filter() -> NDArray[np.float64]:
    """Design the causal Butterworth band-pass 13-35 Hz at 250 Hz (order 4 per edge) as second-order sections, shape [4, 6]."""
    return np.ascontiguousarray(scipy.signal.butter(4, BETA_BAND_HZ, btype="bandpass", fs=LFP_RATE_HZ, output="sos"))
