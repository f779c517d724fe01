"""Differences between visit days: progression from month to month, the day's form, today's levodopa exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

PROGRESSION_PER_VISIT: Final = 0.003  # assumed: log K per month
DAY_LOG_GAIN: Final = 0.08  # assumed: sd of log K between days
DAY_ACTIVITY: Final = 0.5  # assumed: the same day effect in units of the activity drift, as tremor and side effects feel it
DOSE_LOG_SD: Final = 0.25  # between-trial variability 0.17-0.40, Chan, Nutt and Holford 2005
DELAY_SD_H: Final = 0.15  # assumed: absorption is slower after a meal


@dataclass(frozen=True)
class DayEffect:
    """Shifts that all sessions of one day share: of log K, of the activity drift, of levodopa exposure and its delay (hours)."""

    log_gain: float
    activity: float
    dose_factor: float
    delay_h: float


def day_effect(salt: int, visit: int, study_seed: int = 0) -> DayEffect:
    """Draw the day of `visit` (1, 2, ...) of the participant with this salt; another `study_seed` is another run of the same study."""
    form, dose, delay = np.random.default_rng([salt, visit, study_seed]).standard_normal(3)
    return DayEffect(
        log_gain=DAY_LOG_GAIN * form + PROGRESSION_PER_VISIT * (visit - 1),
        activity=DAY_ACTIVITY * form,
        dose_factor=math.exp(DOSE_LOG_SD * dose),
        delay_h=abs(DELAY_SD_H * delay),
    )
