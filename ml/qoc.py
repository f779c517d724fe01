"""End-of-session quality-of-control (QoC) metrics. Source: Gao et al. 2023, section 3."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, make_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.outcomes import BY_FIELD, OUTCOMES
from ml.outcomes.records import Outcome

PLAUSIBLE_INTERVAL_S = (0.08, 3.0)
"""Intervals between open fists: faster is sensor bounce, slower is a pause and no grasp."""

TREMOR_CLASSES = ("unknown", "none", "slight", "mild", "moderate", "strong")
COUNTED = ("mild", "moderate", "strong")
"""Classes that eq:tremor_severity counts."""

SAME_TIME_S = 1.0
"""Minutes may overlap by this much: exports round their times to whole seconds."""

UNTOLD = 0.02
"""Shares of a minute that miss 1 by this much are rounded, not incomplete."""

ROUNDING = 1e-6
"""Shares are stored as float32: together they may exceed the whole by this share of it."""

_COUNTED_COLUMNS = [TREMOR_CLASSES.index(name) for name in COUNTED]


_Values: Any = make_dataclass("_Values", [(o.field, float | None, None) for o in OUTCOMES], frozen=True)
_Margins: Any = make_dataclass("_Margins", [(o.margin.field, float, o.margin.default) for o in OUTCOMES], frozen=True)


@dataclass(frozen=True)
class Qoc(_Values):
    """The outcomes of one session, an attribute per `Outcome.field`; None where not measured.

    Raises:
        ValueError: a value outside its range; the message names it.
    """

    def __post_init__(self) -> None:
        for outcome in OUTCOMES:
            value = getattr(self, outcome.field)
            if value is not None:
                outcome.check(value)

    @staticmethod
    def from_numbers(values: Mapping[str, float | None]) -> Qoc:
        """Make QoCs from numbers by `Outcome.field`, those of whole outcomes as integers."""
        return Qoc(**{name: int(value) if value is not None and BY_FIELD[name].whole else value for name, value in values.items()})


@dataclass(frozen=True)
class Margins(_Margins):
    """By how much an outcome may be worse than under cDBS and still count as no worse, an attribute per `Margin.field`.

    Raises:
        ValueError: a margin that is not above 0, or a share of 1 or more.
    """

    def __post_init__(self) -> None:
        for outcome in OUTCOMES:
            outcome.margin.check(self.of(outcome))

    def of(self, outcome: Outcome) -> float:
        """Return the margin of an outcome, a share or points."""
        return float(getattr(self, outcome.margin.field))


def failed_qoc(measured: Iterable[Qoc]) -> Qoc:
    """Return what a session that was stopped for the participant's sake counts as, in learning, evaluation and analyses alike.

    Args:
        measured: the outcomes of all sessions of the participant that count, stopped ones among them.
    """
    known = list(measured)
    return Qoc(**{o.field: o.failed(getattr(q, o.field) for q in known) for o in OUTCOMES})


def grasp_frequency(open_fist_s: NDArray[np.float64]) -> float:
    """Compute the grasp frequency over one hand-grasp test (eq:grasp_speed).

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
    """Compute the share of the session with mild or worse tremor (eq:tremor_severity), per cent.

    Args:
        class_seconds: seconds per class; `mild`, `moderate` and `strong` count, every other key does not.
        session_s: length of the whole session, seconds; minutes of unknown class are part of it.

    Raises:
        ValueError: a session without length, or more tremor than session.
    """
    if session_s <= 0:
        raise ValueError(f"a session must be longer than 0 s, not {session_s}")
    tremor_s = sum(class_seconds.get(name, 0.0) for name in COUNTED)
    if tremor_s > session_s * (1 + ROUNDING):
        raise ValueError(f"{tremor_s:.1f} s of tremor do not fit into a session of {session_s:.1f} s")
    return min(100.0, 100.0 * tremor_s / session_s)


@dataclass(frozen=True)
class TremorReading:
    """Tremor of one session out of a watch's minutes, in both readings of eq:tremor_severity.

    Attributes:
        duration_weighted, arg_max: share of the session with mild, moderate or strong tremor, per cent. The first adds up the shares of the
            minutes (`tremor_by_duration`), the second gives each minute whole to its largest class (`tremor_by_class`). Time that no
            divided minute covers counts as time without tremor, so both are lower bounds where `covered_s` is short of `session_s`.
        class_seconds: seconds of the session per class of `TREMOR_CLASSES`, by duration.
        session_s: length of the session, s.
        covered_s: seconds of it that minutes with divided tremor cover.
        undivided_s: seconds of minutes that report only the sum of all tremor; not part of `covered_s`.
    """

    duration_weighted: float
    arg_max: float
    class_seconds: dict[str, float]
    session_s: float
    covered_s: float
    undivided_s: float

    @property
    def unknown_s(self) -> float:
        """Seconds in which the watch could not decide (mostly active movement); the paper counts them into the session."""
        return self.class_seconds["unknown"]


def read_tremor(
    start_s: NDArray[np.float64],
    duration_s: NDArray[np.float64],
    fractions: NDArray[np.float64],
    session_start_s: float,
    session_s: float,
) -> TremorReading:
    """Compute QoC_tremor of one session (eq:tremor_severity) from minutes that each hold a share per class.

    The paper speaks of one class per minute, the watch gives shares. Both readings are given, and they differ. Minutes at the ends of the
    session count by their overlap with it.

    Args:
        start_s, duration_s: begin and length of each minute's measurement, s, shape [n], in any order.
        fractions: share per class in the order of `TREMOR_CLASSES`, shape [n, 6]; NaN where the export does not say.
        session_start_s: begin of the session on the minutes' clock, s.
        session_s: its length, s.

    Raises:
        ValueError: a session without length, shapes that do not fit, or minutes that claim the same time.
    """
    if not session_s > 0:
        raise ValueError(f"a session must be longer than 0 s, not {session_s}")
    if fractions.shape != (start_s.size, len(TREMOR_CLASSES)) or duration_s.shape != start_s.shape:
        raise ValueError(f"shares {fractions.shape} do not fit {start_s.shape} starts and {duration_s.shape} lengths of minutes")
    overlap_s = np.minimum(start_s + duration_s, session_start_s + session_s) - np.maximum(start_s, session_start_s)
    inside = np.flatnonzero(overlap_s > 0)
    inside = inside[np.argsort(start_s[inside], kind="stable")]
    twice = int(np.sum(np.diff(start_s[inside]) < duration_s[inside][:-1] - SAME_TIME_S))
    if twice:
        raise ValueError(f"{twice} minutes begin before the one before has ended: their time would count twice")
    overlap_s, fractions = overlap_s[inside], fractions[inside]
    # minutes may overlap by rounding; together they are never more than the session
    overlap_s = overlap_s / max(1.0, float(overlap_s.sum()) / session_s)
    divided = np.isfinite(fractions[:, _COUNTED_COLUMNS]).all(axis=1)
    seconds = [(by(fractions[divided]) * overlap_s[divided, None]).sum(axis=0) for by in (tremor_by_duration, tremor_by_class)]
    by_duration, by_class = (dict(zip(TREMOR_CLASSES, map(float, s), strict=True)) for s in seconds)
    return TremorReading(
        tremor_percent(by_duration, session_s),
        tremor_percent(by_class, session_s),
        by_duration,
        float(session_s),
        float(overlap_s[divided].sum()),
        float(overlap_s[~divided].sum()),
    )


def tremor_by_duration(fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shares of each minute as the watch reported them, shape [n, 6]; shares that it did not report are 0."""
    return np.nan_to_num(fractions, nan=0.0)


def tremor_by_class(fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Assign each minute whole to its largest class, shape [n, 6] of 0 and 1: the paper's "one class per minute".

    Of equal shares the class that comes first in `TREMOR_CLASSES` has the minute, so never the stronger tremor. Time that the export gives
    to no class counts as unknown.
    """
    shares = np.nan_to_num(fractions, nan=0.0)
    shares[:, 0] += np.maximum(0.0, 1.0 - shares.sum(axis=1) - UNTOLD)
    return np.eye(len(TREMOR_CLASSES))[np.argmax(shares, axis=1)]
