"""Charts of one recording count their windows per trace."""

from __future__ import annotations

import numpy as np
import pytest

from app.study.recordings.charts import Stretch, trace_charts
from app.study.traces import pack
from app.tables.recordings import Recording, Trace


def trace(channel: str, valid: int, n: int = 10) -> Trace:
    values, bits = pack(np.ones(n), np.arange(n) < valid)
    return Trace(
        stream="band_power", channel=channel, unit="device units", source="device_power", decode_version=1, dt_s=2.0, first_end_s=2.0, n=n,
        values_f32=values, valid_bits=bits,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("valid", "said"),
    [
        ((7,), "n = 7 of 10 windows valid"),
        ((7, 7), "2 traces, n = 7 of 10 windows valid in each"),
        ((2, 0, 9), "3 traces, n = 0 to 9 of 10 windows valid in each"),
    ],
)
def test_the_subtitle_counts_windows_per_trace(valid: tuple[int, ...], said: str) -> None:
    traces = [trace(f"band {i}", v) for i, v in enumerate(valid)]
    (chart,) = trace_charts(Recording(id=1, details={}), traces, Stretch(0.0, 0.0, 20.0))
    assert chart.subtitle == f"device units over 2 s · {said}"
