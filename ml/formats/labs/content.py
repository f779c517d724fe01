"""Content of a recording of any lab, before steps are made of it: channels with their times, marks, and the clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.facts.clocks import unknown
from ml.formats.labs.marks import Mark
from ml.formats.labs.names import ChannelName
from ml.formats.labs.timing import Timing

Floats = NDArray[np.float64]

ZEROS = 3
"""So many exact zeros in a row are a gap that a program wrote as zero volts."""
LOCAL_TIME = "the file has a local time and no offset from UTC"


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel.

    Attributes:
        name: as the lists of names read it. shown: its name for people.
        unit: in one spelling; empty where the file states none that is known.
        timing: of its samples.
        read: gives the samples in `unit`, [n], NaN where there is none.
        group: channels that share it were sampled at the same instants.
    """

    name: ChannelName
    shown: str
    unit: str
    timing: Timing
    read: Callable[[], Floats]
    group: int = 0


@dataclass(frozen=True, slots=True)
class Course:
    """Amplitude from irregular samples: from `t_s` [n] on, `values` [n] in `unit` hold."""

    name: ChannelName
    shown: str
    unit: str
    t_s: Floats
    values: Floats


@dataclass(slots=True)
class Content:
    """Everything that a reader found.

    Attributes:
        kind: of the format.
        channels, courses, marks: of one session, on one clock.
        started: a time of that clock, s, and the date that it was; None where the file has none.
        clock_known: whether the date is UTC, or has a stated offset from it. utc_offset_h: that offset.
        marks_pause: whether marks are lost where samples are, as both are in the same records.
        cut_s: time after which the file is lost; None where it is whole.
        stated: marks that hold for their duration alone, of a table of events.
    """

    kind: str
    channels: list[Channel] = field(default_factory=list)
    courses: list[Course] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    started: tuple[float, datetime] | None = None
    clock_known: bool = False
    utc_offset_h: float | None = None
    marks_pause: bool = True
    cut_s: float | None = None
    settings: dict[str, Any] = field(default_factory=dict)

    def start_at(self, t_s: float) -> datetime | None:
        """Convert a time of its clock to a date in UTC; as the file shows it where the offset is unknown."""
        if self.started is None:
            return None
        at, date = self.started
        aware = date if date.tzinfo is not None else date.replace(tzinfo=UTC)
        return datetime.fromtimestamp(aware.timestamp() + t_s - at, UTC)

    def clock_settings(self, started_at: datetime | None) -> Mapping[str, Any]:
        """Describe the clock as it is stored with the recording."""
        offset = {"utc_offset_h": self.utc_offset_h} if self.utc_offset_h is not None else {}
        if started_at is None or self.clock_known:
            return offset
        return {**offset, "clock": unknown("computer", LOCAL_TIME).as_settings(started_at)}


def measured_samples(x: Floats) -> NDArray[np.bool_]:
    """Mark the samples that were measured, [n]: no NaN or infinity, and no run of three or more exact zeros."""
    good = np.isfinite(x)
    zero = x == 0.0
    if zero.sum() < ZEROS:
        return good
    edges = np.flatnonzero(np.diff(np.concatenate(([0], zero.astype(np.int8), [0]))))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if end - begin >= ZEROS:
            good[begin:end] = False
    return good
