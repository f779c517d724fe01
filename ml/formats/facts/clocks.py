"""Clocks of devices and computers: a moment knows its clock, and is converted to UTC only by an offset that was estimated.

The offset of a clock is the time that it is ahead of UTC. A file that has both clocks at one moment, at its begin and at its end, gives an
estimate. Between the two the clock is taken to drift evenly. Where no pair is plausible, the offset is unknown. Moments then stay on their
own clock, and the file's report says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Literal

Clock = Literal["utc", "implant", "programmer", "computer", "wrist"]

READ_WITHIN_S = 15.0
"""Two clocks of one file are read so far apart: 17 s differ between begin and end of a real report of 30 min."""
LARGEST_S = 24 * 3600.0
"""An offset beyond a day is no clock that runs ahead: one of the two dates is wrong."""
LARGEST_CHANGE_S = 600.0
"""Offsets at begin and end that differ by more were not read from the same two clocks."""


class OtherClock(ValueError):
    """Raised where a moment of one clock is compared with, or corrected by the offset of, another."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A time as one clock shows it."""

    clock: Clock
    value: datetime

    def seconds_after(self, other: Moment) -> float:
        """Compute the seconds since another moment of the same clock. Raises OtherClock for one of another."""
        if self.clock != other.clock:
            raise OtherClock(f"a time of the {self.clock} clock cannot be compared with one of the {other.clock} clock")
        return (self.value - other.value).total_seconds()


@dataclass(frozen=True, slots=True)
class Offset:
    """Offset of one clock from UTC.

    Attributes:
        clock: which one.
        pairs: (time of the clock, seconds ahead of UTC), in time order; empty where the offset is unknown.
        uncertainty_s: within which it is known; None where it is unknown.
        why: what it rests on, or why it is unknown, as the end of a sentence.
        doubtful: the two estimates differ so much that a person should look.
    """

    clock: Clock
    pairs: tuple[tuple[datetime, float], ...]
    uncertainty_s: float | None
    why: str
    doubtful: bool = False

    @property
    def known(self) -> bool:
        """True where moments can be converted to UTC."""
        return bool(self.pairs)

    @property
    def ahead_s(self) -> float | None:
        """Seconds ahead of UTC at the first pair; None where unknown."""
        return self.pairs[0][1] if self.pairs else None

    def ahead_at(self, value: datetime) -> float:
        """Compute the seconds ahead of UTC when the clock shows `value`; 0 where unknown."""
        if not self.pairs:
            return 0.0
        (first, begin), (last, end) = self.pairs[0], self.pairs[-1]
        length = (last - first).total_seconds()
        if length <= 0:
            return begin
        share = min(max((value - first).total_seconds() / length, 0.0), 1.0)
        return begin + share * (end - begin)

    def utc(self, moment: Moment) -> datetime:
        """Convert a moment to UTC; where the offset is unknown it stays as the clock shows it.

        Raises:
            OtherClock: the moment is of another clock.
        """
        if moment.clock != self.clock:
            raise OtherClock(f"the offset of the {self.clock} clock says nothing of a time of the {moment.clock} clock")
        return moment.value - timedelta(seconds=self.ahead_at(moment.value))

    def device_time(self, utc: datetime) -> datetime:
        """Convert a time that `utc` gave back to what the clock showed."""
        return utc + timedelta(seconds=self.ahead_at(utc + timedelta(seconds=self.ahead_at(utc))))

    def as_settings(self, started_at: datetime | None = None) -> dict[str, Any]:
        """Describe the offset as it is stored with a recording that begins at `started_at`; seconds are None where it is unknown."""
        begin, end = (self.pairs[0][1], self.pairs[-1][1]) if self.pairs else (None, None)
        return {
            "name": self.clock,
            "known": self.known,
            "ahead_s": begin,
            "ahead_at_end_s": end,
            "uncertainty_s": self.uncertainty_s,
            "why": self.why,
            "showed": None if started_at is None else self.device_time(started_at).isoformat(timespec="milliseconds"),
        }


def unknown(clock: Clock, why: str) -> Offset:
    """Make the offset of a clock of which nothing is known, for a reason."""
    return Offset(clock, (), None, why)


def estimate(clock: Clock, pairs: Sequence[tuple[datetime | None, datetime | None]]) -> Offset:
    """Estimate how far a clock is ahead of UTC, from times that it and UTC showed at one moment.

    Args:
        clock: which one.
        pairs: (time of the clock, UTC), in time order, each None where the file has none.
    """
    whole = [(own, (own - utc).total_seconds()) for own, utc in pairs if own is not None and utc is not None]
    if not whole:
        return unknown(clock, "the file does not show it beside another clock")
    believed = [(own, ahead) for own, ahead in whole if abs(ahead) <= LARGEST_S]
    if not believed:
        return unknown(clock, f"it would be {lead_in_words(whole[0][1])} UTC, which is no clock but a wrong date")
    if len(believed) == 1:
        return Offset(clock, (believed[0],), 4 * READ_WITHIN_S, "one comparison with the programmer's clock", len(whole) > 1)
    change = abs(believed[-1][1] - believed[0][1])
    if change > LARGEST_CHANGE_S:
        both = f"{lead_in_words(believed[0][1])} UTC at the begin, {lead_in_words(believed[-1][1])} at the end"
        return unknown(clock, f"it would be {both}, so one of the dates is wrong")
    why = "comparison with the programmer's clock at begin and end"
    return Offset(clock, (believed[0], believed[-1]), max(READ_WITHIN_S, change), why, change > 4 * READ_WITHIN_S)


def lead_in_words(ahead_s: float) -> str:
    """Describe how far a clock is ahead or behind, such as `37 min 34 s ahead of`."""
    seconds = round(abs(ahead_s))
    days, hours, minutes, rest = seconds // 86_400, seconds // 3600 % 24, seconds // 60 % 60, seconds % 60
    parts = [(days, "d"), (hours, "h"), (minutes, "min"), (rest, "s")]
    length = " ".join(f"{n} {unit}" for n, unit in parts if n) or "0 s"
    return f"{length} {'behind' if ahead_s < 0 else 'ahead of'}"
