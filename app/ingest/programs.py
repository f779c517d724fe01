"""Choice of the program whose amplitude a controller is taken to have set, where a recording has several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from app.study.sessions.stimulation import SILENT_MA
from app.study.traces import AMPLITUDE_STREAM, amplitude_program, unpack
from app.tables.recordings import Trace


class How(StrEnum):
    """Course of the amplitude of a program."""

    MOVED = "moved"
    CONSTANT = "constant"
    OFF = "off"
    UNKNOWN = "unknown"


ORDER = list(How)
"""A controller moves its program's amplitude; where none moved, one that stimulated is more than one that was off."""


@dataclass(frozen=True)
class Program:
    """One program of a recording, and how its amplitude ran; `low`, `high` of the known values, NaN without any."""

    number: int
    how: How
    low: float
    high: float


def of_part(traces: Sequence[Trace], start_s: float, stop_s: float) -> list[Program]:
    """List every program of a recording within a part of it (s), the one that a controller is taken to have set first."""
    found = [_program(t, start_s, stop_s) for t in traces if t.stream == AMPLITUDE_STREAM]
    return sorted(found, key=lambda p: (ORDER.index(p.how), -np.nan_to_num(p.high - p.low), -np.nan_to_num(p.high), p.number))


def _program(trace: Trace, start_s: float, stop_s: float) -> Program:
    ends = trace.first_end_s + trace.dt_s * np.arange(trace.n)
    values = unpack(trace)[(ends > start_s) & (ends <= stop_s + trace.dt_s / 2)]
    known = values[~np.isnan(values)]
    if not known.size:
        return Program(amplitude_program(trace), How.UNKNOWN, np.nan, np.nan)
    low, high = float(known.min()), float(known.max())
    how = How.OFF if high <= SILENT_MA else How.MOVED if high - low > SILENT_MA else How.CONSTANT
    return Program(amplitude_program(trace), how, low, high)
