"""One signal of a session, as the writers of files take it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Signal:
    """One channel or trace of a session.

    Attributes:
        recording: its number. hemisphere: `left`, `right` or None. stream: `lfp`, or that of a trace. channel, unit: as stored.
        t_s: seconds from the session's start, [n]: of a sample, or the end of a trace's row.
        values: float32, [n]; NaN where a trace's row is invalid.
        rates_hz: rates of the samples; empty for traces.
    """

    recording: int
    hemisphere: str | None
    stream: str
    channel: str
    unit: str
    t_s: NDArray[np.float64]
    values: NDArray[np.float32]
    rates_hz: tuple[float, ...] = ()
