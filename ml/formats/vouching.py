"""Two sources of one course in time: a log of changes, and readings of what was set at single moments. Neither is believed beyond what it
says."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from ml.formats.dose import LIMIT_TOLERANCE_MA, Dose

T = TypeVar("T")
LAG_MS = 2000.0
"""A reading may follow the change that it shows, or precede the log's record of it, by so much. A real recording has 1.1 s at most."""


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Time in which two sources state different doses, in ms of their clock.

    Attributes:
        at_ms: of the reading. begin_ms, end_ms: from the last statement before it that agrees to the next one; `end_ms` may be infinite.
        logged: times and doses by the log, the first at `begin_ms`. read: dose by the reading, from `at_ms` on.
    """

    at_ms: float
    begin_ms: float
    end_ms: float
    logged: tuple[tuple[float, Dose], ...]
    read: Dose


@dataclass(slots=True)
class Vouching(Generic[T]):
    """Collected statements, in ms of one clock.

    Attributes:
        dose_of: dose of a state, with NaN where unknown. unknown: state of which nothing is known.
        log: moments at which the log stated the state in force. readings: the same of the other source, each in order of time.
    """

    dose_of: Callable[[T], Dose]
    unknown: T
    log: list[tuple[float, T]] = field(default_factory=list)
    readings: list[tuple[float, T]] = field(default_factory=list)

    def combine(self, times_ms: Sequence[float], states: Sequence[T]) -> tuple[list[tuple[float, T]], list[Disagreement]]:
        """Combine both sources.

        Where the log is unknown it stays so. Readings that agree say nothing of the time between them: what is changed and changed back
        shows in none. A reading that contradicts the log makes the state unknown, from the statement before it to the next one that
        agrees with the log.

        Args:
            times_ms: from which the log's states hold, [n], ascending. states: of the log, [n].

        Returns:
            States with the times from which they hold; where the sources differ.
        """
        read = [(t, s) for t, s in self.readings if _known(self.dose_of(s)) and times_ms and t >= times_ms[0] - LAG_MS]
        agreed, against = [], []
        for t, state in read:
            first, last = (max(0, bisect_right(times_ms, t + by) - 1) for by in (-LAG_MS, LAG_MS))
            near = [self.dose_of(s) for s in states[first : last + 1]]
            if not all(map(_known, near)) or any(_same(dose, self.dose_of(state)) for dose in near):
                agreed.append((t, state))
            else:
                against.append((t, state))
        points = sorted([*self.log, *agreed], key=lambda point: point[0])
        course = list(zip(times_ms, states, strict=True))
        out, found = course, []
        for t, state in against:
            begin = max((p for p, _ in points if p <= t), default=times_ms[0])
            end = min((p for p, _ in points if p > t), default=math.inf)
            out = _replace(out, begin, end, self.unknown)
            logged = [(max(at, begin), self.dose_of(s)) for at, s in course if at < end]
            since = max((i for i, (at, _) in enumerate(logged) if at <= begin), default=0)
            found.append(Disagreement(t, begin, end, tuple(logged[since:]), self.dose_of(state)))
        return out, found


def _replace(course: list[tuple[float, T]], begin: float, end: float, state: T) -> list[tuple[float, T]]:
    """Put a state over part of a course."""
    after = [s for t, s in course if t <= end][-1:]
    kept = [(t, s) for t, s in course if t < begin]
    tail = [(t, s) for t, s in course if t > end]
    return [*kept, (begin, state), *([(end, after[0])] if after and math.isfinite(end) else []), *tail]


def _known(dose: Dose) -> bool:
    return all(math.isfinite(a) for a in dose.amplitude_ma)


def _same(one: Dose, other: Dose) -> bool:
    """Decide whether two known doses are equal to the resolution of the devices."""
    return len(one.amplitude_ma) == len(other.amplitude_ma) and all(
        abs(a - b) < LIMIT_TOLERANCE_MA for a, b in zip(one.amplitude_ma, other.amplitude_ma, strict=True)
    )
