"""Measurements at the end of a session: open-fist times, the rating, tremor class per minute; and the paper's formulas over them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ml.population.participants import ParticipantModel
from ml.population.physiology.brain import PERIOD_S, STREAM_OUTCOMES, gauss_pair
from ml.qoc import Qoc, grasp_frequency, tremor_percent

GRASP_TEST_S: Final = 10.0  # Gao et al. 2023, section 3
GRASP_TEST_STEPS: Final = 5
TREMOR_CLASSES: Final = ("none", "slight", "mild", "moderate", "strong")
TREMOR_BOUNDS: Final = (0.3, 1.0, 2.0, 3.2)  # assumed: mean severity of a minute at which the next class begins
STEPS_PER_MINUTE: Final = 30

MEASURED: Final = ("grasp_hz", "rating", "tremor_percent")
"""Outcomes that a synthetic participant shows, by `Outcome.field`."""

_GRASP_NOISE_HZ, _INTERVAL_CV, _DECREMENT = 0.12, 0.06, 0.01  # assumed
_RATING_TOP, _RATING_BRADY, _RATING_TREMOR, _RATING_OVERLOAD, _RATING_CHANGE, _RATING_NOISE = 9.0, 3.0, 4.0, 3.0, 1.0, 0.5  # assumed
_TREMOR_FULL = 2.5  # assumed: severity at which tremor costs its full share of the rating


@dataclass(frozen=True)
class Outcomes:
    """Measurements at the end of one session.

    Attributes:
        open_fist_s: times of open fists in the 10 s test, [N], seconds from its start.
        tremor_minutes: class of each minute, the last one possibly shorter.
        qoc: the QoCs by the paper's formulas.
    """

    open_fist_s: NDArray[np.float64]
    tremor_minutes: tuple[str, ...]
    qoc: Qoc


def measure(
    participant: ParticipantModel,
    counters: NDArray[np.uint64],
    amplitude: NDArray[np.float64],
    brady: NDArray[np.float64],
    tremor: NDArray[np.float64],
    overload: NDArray[np.float64],
) -> Outcomes:
    """Make the end-of-session measurements of one session.

    Args:
        participant: who. counters: the session's random streams, [STREAMS], advanced in place.
        amplitude, brady, tremor, overload: amplitude fraction and symptoms of every step, [T].
    """
    p = participant.symptoms
    late = float(brady[-GRASP_TEST_STEPS:].mean())
    g_grasp, g_rating = gauss_pair(counters, STREAM_OUTCOMES)
    frequency = p.grasp_max_hz - (p.grasp_max_hz - p.grasp_min_hz) * late + _GRASP_NOISE_HZ * g_grasp
    fists = _open_fists(counters, min(max(frequency, 0.4), 4.5), late)
    score = _RATING_TOP + p.rating_bias - _RATING_BRADY * float(brady.mean())
    score -= _RATING_TREMOR * float(np.minimum(tremor / _TREMOR_FULL, 1.0).mean())
    score -= _RATING_OVERLOAD * p.side_effect * float(overload.mean())
    score -= _RATING_CHANGE * float(np.abs(np.diff(amplitude)).mean()) if amplitude.size > 1 else 0.0
    rating = int(min(max(round(score + _RATING_NOISE * g_rating), 1), 10))
    minutes = tremor_minutes(tremor)
    share = tremor_percent(minute_seconds(minutes, tremor.size), tremor.size * PERIOD_S)
    return Outcomes(fists, minutes, Qoc(**dict(zip(MEASURED, (grasp_frequency(fists), rating, share), strict=True))))


def tremor_minutes(tremor: NDArray[np.float64]) -> tuple[str, ...]:
    """Classify each minute from the severity of its steps, [T]; a last part of a minute counts as one."""
    starts = range(0, tremor.size, STEPS_PER_MINUTE)
    means = [tremor[i : i + STEPS_PER_MINUTE].mean() for i in starts]
    return tuple(TREMOR_CLASSES[int(np.searchsorted(TREMOR_BOUNDS, mean, side="right"))] for mean in means)


def minute_seconds(minutes: tuple[str, ...], steps: int) -> dict[str, float]:
    """Count the seconds of a session per tremor class; `steps` says how long the last minute was."""
    seconds: dict[str, float] = {}
    for i, name in enumerate(minutes):
        seconds[name] = seconds.get(name, 0.0) + PERIOD_S * min(STEPS_PER_MINUTE, steps - i * STEPS_PER_MINUTE)
    return seconds


def _open_fists(counters: NDArray[np.uint64], frequency_hz: float, brady: float) -> NDArray[np.float64]:
    """Draw open-fist times: intervals vary around 1 / frequency and lengthen with bradykinesia as the hand tires."""
    first, _ = gauss_pair(counters, STREAM_OUTCOMES)
    times = [0.5 / frequency_hz * (1 + _INTERVAL_CV * min(max(first, -3.0), 3.0))]
    planned = frequency_hz * GRASP_TEST_S
    while True:
        draw, _ = gauss_pair(counters, STREAM_OUTCOMES)
        tired = 1 + _DECREMENT * max(brady, 0.0) * (len(times) - planned / 2)
        step = tired * (1 + _INTERVAL_CV * min(max(draw, -3.0), 3.0)) / frequency_hz
        if times[-1] + step > GRASP_TEST_S:
            return np.round(np.array(times), 3)
        times.append(times[-1] + step)
