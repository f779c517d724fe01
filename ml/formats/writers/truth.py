"""Truth of a written file: what was delivered, when it began, and until when the file states it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True)
class Course:
    """Delivered amplitude of one program: from `times_s` on (the first at or before 0), `levels_ma` holds.

    Attributes:
        times_s: ascending, s of the true timeline, [n]. levels_ma: mA, [n].
        cycle_s: lengths on and off, and the time at which a cycle began, where therapy cycles; None where it does not.
    """

    times_s: Sequence[float]
    levels_ma: Sequence[float]
    cycle_s: tuple[float, float, float] | None = None

    def level_at(self, t_s: float) -> float:
        """Compute the delivered amplitude at a time, mA."""
        level = self.levels_ma[max(0, bisect_right(self.times_s, t_s) - 1)]
        if self.cycle_s is None:
            return level
        on, off, begin = self.cycle_s
        return level if (t_s - begin) % (on + off) < on else 0.0

    def range_within(self, begin_s: float, end_s: float) -> tuple[float, float]:
        """Find the lowest and the highest amplitude that was delivered between two times, mA."""
        edges = [t for t in self.times_s if begin_s < t <= end_s]
        if self.cycle_s is not None:
            on, off, begin = self.cycle_s
            first = math.floor((begin_s - begin) / (on + off))
            last = math.ceil((end_s - begin) / (on + off))
            turns = [begin + k * (on + off) + part for k in range(first, last + 1) for part in (0.0, on)]
            edges += [t for t in turns if begin_s < t <= end_s]
        found = [self.level_at(t) for t in (begin_s, *edges, end_s)]
        return min(found), max(found)


@dataclass(frozen=True)
class Truth:
    """Events of one recording.

    Attributes:
        number: of the run in its file, from 0.
        hemisphere: `left` or `right`; None where the file need not say.
        began: UTC of the first sample that the file holds, or of the first interval of power where it holds no sample.
        length_s: from then to the last sample.
        courses: delivered amplitude of each program that stimulates, by the name of its trace; times from `began`.
        known_until_s: the file states the amplitude until then; after it nothing can be known.
        knowable: whether the file states the amplitude at all.
        dated: whether the file has what converts its dates to UTC.
    """

    number: int
    hemisphere: str | None
    began: datetime
    length_s: float
    courses: dict[str, Course]
    known_until_s: float = math.inf
    knowable: bool = True
    dated: bool = True
