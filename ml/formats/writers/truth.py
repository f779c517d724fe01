"""Truth of a written file: what was delivered, when it began, and until when the file states it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise


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

    def means_within(self, begin_s: float, end_s: float, slack_s: tuple[float, float], share: float) -> tuple[float, float]:
        """Find the lowest and the highest mean that a recording of the amplitude between two times may have, mA.

        Args:
            begin_s, end_s: of a step.
            slack_s: how much earlier, and how much later, the recording may show a change.
            share: of the step that is known, at least; the mean is over that.
        """
        edges = sorted({begin_s, end_s, *(t + by for t in self._edges(begin_s, end_s, slack_s) for by in (-slack_s[0], 0.0, slack_s[1]))})
        edges = [t for t in edges if begin_s <= t <= end_s]
        pieces = []
        for start, stop in pairwise(edges):
            middle = (start + stop) / 2
            # a change shown early is of a later moment, one shown late of an earlier
            near = [t for t in self._edges(middle, middle, slack_s) if middle - slack_s[1] < t <= middle + slack_s[0]]
            levels = [self.level_at(t) for t in (middle - slack_s[1], *near, middle + slack_s[0])]
            pieces.append((stop - start, min(levels), max(levels)))
        known_s = share * (end_s - begin_s)
        lows, highs = sorted((low, s) for s, low, _ in pieces), sorted(((high, s) for s, _, high in pieces), reverse=True)
        return _mean_of(lows, known_s), _mean_of(highs, known_s)

    def _edges(self, begin_s: float, end_s: float, slack_s: tuple[float, float]) -> list[float]:
        """List the changes between two times, and as far from them as a recording may show them."""
        begin_s, end_s = begin_s - slack_s[1], end_s + slack_s[0]
        edges = [t for t in self.times_s if begin_s < t <= end_s]
        if self.cycle_s is not None:
            on, off, begin = self.cycle_s
            first = math.floor((begin_s - begin) / (on + off))
            last = math.ceil((end_s - begin) / (on + off))
            turns = [begin + k * (on + off) + part for k in range(first, last + 1) for part in (0.0, on)]
            edges += [t for t in turns if begin_s < t <= end_s]
        return edges


def _mean_of(levels: list[tuple[float, float]], known_s: float) -> float:
    """Average the first levels of (mA, s), as many as add up to a time."""
    total, left = 0.0, known_s
    for level, seconds in levels:
        total += level * min(seconds, left)
        left -= min(seconds, left)
    return total / known_s


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
        ahead_s: how far the clock that dates the recording was ahead of UTC.
    """

    number: int
    hemisphere: str | None
    began: datetime
    length_s: float
    courses: dict[str, Course]
    known_until_s: float = math.inf
    knowable: bool = True
    dated: bool = True
    ahead_s: float = 0.0
