"""Symptoms of a synthetic participant in steps of 2 s: tremor, bradykinesia and over-stimulation.

The forms are assumed unless a source is named. Tremor returns within seconds of low stimulation in participants 2-4 and comes in episodes
in participant 1 (Gao et al. 2023, appendix). Bradykinesia follows beta. It has a fast part (15-30 s, Keresztenyi 2007) and a slow part that
washes out over ten minutes (Cooper 2011, 2013).
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ml.compiled import compiled
from ml.population.participants import ParticipantModel
from ml.population.physiology.brain import PERIOD_S, STREAM_SYMPTOMS, gauss_pair, saturation, uniform

TREMOR, EPISODE, FAST, SLOW, BURDEN, OVERLOAD = range(6)
STATE_SIZE: Final = 6
_MAX, _THETA, _UP, _DOWN, _EPISODIC, _SHARE, _A50, _HILL, _B_CDBS, _B_OFF = range(10)

_TREMOR_A50, _TREMOR_SLOPE = 0.50, 0.95
_TREMOR_MEDICATION, _TREMOR_ACTIVITY = 0.18, 0.22
_TREMOR_NOISE = 0.08
_EPISODE_PER_S, _EPISODE_MEAN_S = 1.0 / 240.0, 45.0
_FAST_TAU_S = 20.0
_SLOW_ON_S, _SLOW_OFF_S = 150.0, 600.0
_BURDEN_TAU_S = 60.0
_OVER_TOLERANCE, _OVER_MEDICATION, _OVER_ACTIVITY, _OVER_TAU_S = 0.70, 0.30, 0.55, 20.0


@compiled()
def advance(state: Any, counters: Any, constants: Any, amplitude: Any, medication: Any, activity: Any, beta: Any, brady: Any) -> None:
    """Advance N participants by 2 s, in place.

    Args:
        state: [N, STATE_SIZE]. counters: random streams, [N, STREAMS]. constants: [N, 10] from `constants_of`.
        amplitude: amplitude fraction in force, [N]. medication: effect 0-1, [N].
        activity: drift of the parkinsonian state (sd about 1), [N].
        beta: P_beta of this period in uV, [N]. brady: [N], receives bradykinesia (0 none, 1 full).
    """
    for i in range(state.shape[0]):
        s, c, a, m = state[i], constants[i], amplitude[i], medication[i]
        need = c[_THETA] + _TREMOR_MEDICATION * (1.0 - m) + _TREMOR_ACTIVITY * activity[i]
        level = (need - _TREMOR_SLOPE * saturation(a, _TREMOR_A50, 2.0)) / c[_THETA]
        chance = uniform(counters[i], STREAM_SYMPTOMS)
        noise, _ = gauss_pair(counters[i], STREAM_SYMPTOMS)
        if c[_EPISODIC] > 0.0:
            if s[EPISODE] > 0.0:
                s[EPISODE] = 0.0 if chance < PERIOD_S / _EPISODE_MEAN_S else 1.0
            else:
                s[EPISODE] = 1.0 if chance < PERIOD_S * _EPISODE_PER_S * (1.3 - a) else 0.0
            level = s[EPISODE]
        target = c[_MAX] * min(max(level, 0.0), 1.3)
        tau = c[_UP] if target > s[TREMOR] else c[_DOWN]
        s[TREMOR] = max(0.0, target + (s[TREMOR] - target) * math.exp(-PERIOD_S / tau) + _TREMOR_NOISE * noise * min(1.0, target))
        direct = saturation(a, c[_A50], c[_HILL])
        s[FAST] = direct + (s[FAST] - direct) * math.exp(-PERIOD_S / _FAST_TAU_S)
        s[SLOW] = direct + (s[SLOW] - direct) * math.exp(-PERIOD_S / (_SLOW_ON_S if direct > s[SLOW] else _SLOW_OFF_S))
        s[BURDEN] = beta[i] + (s[BURDEN] - beta[i]) * math.exp(-PERIOD_S / _BURDEN_TAU_S)
        excess = max(0.0, a * a * (1.0 + _OVER_MEDICATION * m) - _OVER_TOLERANCE - _OVER_ACTIVITY * activity[i])
        s[OVERLOAD] = excess + (s[OVERLOAD] - excess) * math.exp(-PERIOD_S / _OVER_TAU_S)
        x = min(max((s[BURDEN] - c[_B_CDBS]) / (c[_B_OFF] - c[_B_CDBS]), -0.3), 1.5)
        brady[i] = c[_SHARE] * x + (1.0 - c[_SHARE]) * (1.0 - 0.6 * s[FAST] - 0.4 * s[SLOW]) - 0.15 * m + 0.1


def constants_of(participant: ParticipantModel, sessions: int) -> NDArray[np.float64]:
    """Compute constants of N sessions, shape [N, 10]."""
    p, reference = participant.symptoms, participant.reference
    row = [p.tremor_max, p.tremor_theta, p.tremor_up_s, p.tremor_down_s, float(p.tremor_episodic)]
    row += [p.brady_beta_share, p.brady_a50, p.brady_hill, reference.cdbs, reference.off]
    return np.repeat(np.array([row]), sessions, axis=0)


def initial_state(participant: ParticipantModel, sessions: int, amplitude: float) -> NDArray[np.float64]:
    """Compute the state of N participants after a long time at one constant amplitude, shape [N, STATE_SIZE]."""
    p, reference = participant.symptoms, participant.reference
    state = np.zeros((sessions, STATE_SIZE))
    state[:, FAST] = state[:, SLOW] = saturation(amplitude, p.brady_a50, p.brady_hill)
    state[:, BURDEN] = reference.off + (reference.cdbs - reference.off) * state[0, FAST]
    return state
