"""End-of-session quality-of-control (QoC) metrics. Source: Gao et al. 2023, section 3."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PLAUSIBLE_INTERVAL_S = (0.08, 3.0)
"""Intervals between open fists: faster is sensor bounce, slower is a pause and no grasp."""


@dataclass(frozen=True)
class Qoc:
    """The three QoCs of one session; None where it was not measured.

    Attributes:
        grasp_hz: grasp frequency, Hz (eq:grasp_speed).
        rating: the participant's rating, whole number 1-10 (eq:patient_rating).
        tremor_percent: share of the session with mild, moderate or strong tremor, per cent (eq:tremor_severity).

    Raises:
        ValueError: a value outside its range; the message names it.
    """

    grasp_hz: float | None = None
    rating: int | None = None
    tremor_percent: float | None = None

    def __post_init__(self) -> None:
        if self.grasp_hz is not None and not (math.isfinite(self.grasp_hz) and self.grasp_hz >= 0):
            raise ValueError(f"grasp frequency must be 0 Hz or more, not {self.grasp_hz}")
        if self.rating is not None and not (self.rating == int(self.rating) and 1 <= self.rating <= 10):
            raise ValueError(f"rating must be a whole number from 1 to 10, not {self.rating}")
        if self.tremor_percent is not None and not 0 <= self.tremor_percent <= 100:
            raise ValueError(f"tremor must lie between 0 and 100 %, not {self.tremor_percent}")


def grasp_frequency(open_fist_s: NDArray[np.float64]) -> float:
    """Grasp frequency over one hand-grasp test (eq:grasp_speed).

    Args:
        open_fist_s: times of consecutive open fists, shape [N], seconds, strictly increasing.

    Returns:
        Grasps per second (Hz).

    Raises:
        ValueError: fewer than two open fists, or times that do not increase.
    """
    intervals = np.diff(open_fist_s)
    if intervals.size == 0:
        raise ValueError("grasp frequency needs at least two open fists")
    if np.any(intervals <= 0):
        raise ValueError(f"open-fist times must increase; they do not after {open_fist_s[:-1][intervals <= 0][0]:.3f} s")
    return float(1.0 / intervals.mean())


def tremor_percent(class_seconds: dict[str, float], session_s: float) -> float:
    """Share of the session with mild or worse tremor (eq:tremor_severity), per cent.

    Args:
        class_seconds: seconds per class; `mild`, `moderate` and `strong` count, every other key does not.
        session_s: length of the whole session, seconds; minutes of unknown class are part of it.

    Raises:
        ValueError: a session without length, or more tremor than session.
    """
    if session_s <= 0:
        raise ValueError(f"a session must be longer than 0 s, not {session_s}")
    tremor_s = sum(class_seconds.get(name, 0.0) for name in ("mild", "moderate", "strong"))
    if tremor_s > session_s * (1 + 1e-9):
        raise ValueError(f"{tremor_s:.1f} s of tremor do not fit into a session of {session_s:.1f} s")
    return min(100.0, 100.0 * tremor_s / session_s)
