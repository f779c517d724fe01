"""Delivered stimulation amplitude of an RC+S recording over time. Source: format notes, A.5 to A.7.

Under embedded adaptive stimulation the adaptive log holds what was delivered, ramps included; otherwise the stimulation log does. Only
enabled programs of the active group stimulate, and with therapy off the amplitude is 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ml.formats.dose import UPPER_PLAUSIBLE_MA, stimulating
from ml.formats.rcs.packets.streams import Adaptive
from ml.formats.rcs.packets.time import PacketTimes
from ml.formats.rcs.settings import ADAPTIVE_BIT, Settings, Therapy, dose_of

HOLD_INTERVALS = 3.0
"""A delivered amplitude is believed for this many update intervals; after a longer silence it is unknown."""


@dataclass(frozen=True, slots=True)
class AmplitudeSteps:
    """Amplitude per program: from `t_ms` (PC clock) [n] on, `amplitude_ma` [n, 4] holds; NaN where unknown."""

    t_ms: NDArray[np.float64]
    amplitude_ma: NDArray[np.float64]
    programs: tuple[int, ...]
    from_adaptive: bool
    assumed_program: bool

    def unknown_within(self, begin_ms: float, end_ms: float) -> AmplitudeSteps:
        """Make the amplitude unknown from a time to another one, which may be infinite."""
        first, last = np.searchsorted(self.t_ms, begin_ms), np.searchsorted(self.t_ms, end_ms, side="right")
        unknown = np.full((1, self.amplitude_ma.shape[1]), np.nan)
        # from the end on, what was in force then; none where the course begins later
        after = self.amplitude_ma[last - 1 : last] if np.isfinite(end_ms) and last > 0 else unknown[:0]
        amplitude = [self.amplitude_ma[:first], unknown, after, self.amplitude_ma[last:]]
        times = [self.t_ms[:first], np.array([begin_ms, *[end_ms] * len(after)]), self.t_ms[last:]]
        return replace(
            self,
            t_ms=np.concatenate(times),
            amplitude_ma=np.concatenate(amplitude),
        )


def amplitude_steps(settings: Settings, adaptive: Adaptive | None, times: PacketTimes | None) -> AmplitudeSteps:
    """Build the amplitude timeline of the whole recording."""
    states = settings.therapy.states
    base_t = np.array(settings.therapy.times_ms, dtype=np.float64)
    base_v = np.array([dose_of(state).amplitude_ma for state in states], dtype=np.float64).reshape(-1, 4)
    disputed = (dose for c in settings.conflicts for dose in (c.read, *(logged for _, logged in c.logged)))
    programs = tuple(sorted({p for state in states for p in stimulating(state.programs)} | {p for dose in disputed for p in dose.programs}))
    if not programs and any(state != Therapy() for state in states):
        programs = (0,)
    assumed = any(state.programs and all(p.enabled is None for p in state.programs) for state in states)
    if adaptive is None or times is None:
        return AmplitudeSteps(base_t, base_v, programs, False, assumed)
    use = np.flatnonzero(np.isfinite(times.last_ms) & (adaptive.status_bits & ADAPTIVE_BIT > 0))
    if use.size == 0:
        return AmplitudeSteps(base_t, base_v, programs, False, assumed)
    order = use[np.argsort(times.last_ms[use], kind="stable")]
    t_ms = times.last_ms[order]
    interval_ms = 1000.0 / adaptive.headers.rate_hz[order]
    values = _mask_idle(adaptive.amplitude_ma[order], t_ms, settings)
    if not programs:
        programs, assumed = (0,), True
    knots_t, knots_v = _with_adaptive(base_t, base_v, t_ms, interval_ms, values, settings)
    return AmplitudeSteps(knots_t, knots_v, programs, True, assumed)


def _mask_idle(values: NDArray[np.float64], t_ms: NDArray[np.float64], settings: Settings) -> NDArray[np.float64]:
    """Set adaptive amplitudes to 0 for programs that do not stimulate, and at times with therapy off."""
    out = values.copy()
    out[(out < 0) | (out >= UPPER_PLAUSIBLE_MA)] = np.nan
    for i, time in enumerate(t_ms):
        therapy = settings.therapy.at(float(time))
        if therapy is not None and therapy.on is False:
            out[i] = 0.0
        elif therapy is not None and therapy.programs:
            out[i, [p for p in range(4) if p not in stimulating(therapy.programs)]] = 0.0
    return out


def _with_adaptive(
    base_t: NDArray[np.float64],
    base_v: NDArray[np.float64],
    t_ms: NDArray[np.float64],
    interval_ms: NDArray[np.float64],
    values: NDArray[np.float64],
    settings: Settings,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Put runs of adaptive updates over the stimulation log; between runs the log holds, or nothing is known while adaptive stays on."""
    silence = np.flatnonzero(np.diff(t_ms) > HOLD_INTERVALS * interval_ms[:-1]) + 1
    pieces_t, pieces_v = [], []
    covered = np.zeros(base_t.size, dtype=bool)
    for run in np.split(np.arange(t_ms.size), silence):
        begin, end = t_ms[run[0]] - interval_ms[run[0]], t_ms[run[-1]] + interval_ms[run[-1]]
        covered |= (base_t >= begin) & (base_t < end)
        bits = getattr(settings.sensing.at(float(end)), "sense_bits", None)
        last = run[-1] + 1 == t_ms.size
        still_on = bits & ADAPTIVE_BIT > 0 if bits is not None else not last or settings.adaptive_lost
        before = int(np.searchsorted(base_t, end, side="right")) - 1
        after = np.full(4, np.nan) if still_on or before < 0 else base_v[before]
        pieces_t.append(np.concatenate(([begin], t_ms[run][1:], [end])))
        pieces_v.append(np.vstack((values[run], after)))
    all_t = np.concatenate((base_t[~covered], *pieces_t))
    all_v = np.vstack((base_v[~covered], *pieces_v))
    order = np.argsort(all_t, kind="stable")
    return all_t[order], all_v[order]
