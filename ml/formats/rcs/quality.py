"""How whole an RC+S recording is: packets, loss, chunks and clocks per stream, also as sentences in the reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from ml.formats.rcs.beta import flat_share
from ml.formats.rcs.packets.streams import Power, TimeDomain, TimeSync
from ml.formats.rcs.packets.time import PacketHeaders, PacketTimes, Rejected, device_clock_drift
from ml.formats.recording import FileReport

STEMS = {
    "time_domain": "RawDataTD",
    "power": "RawDataPower",
    "adaptive": "AdaptiveLog",
    "accel": "RawDataAccel",
    "fft": "RawDataFFT",
    "time_sync": "TimeSync",
}
"""File of each stream."""

COUNTED = {"errors": "ErrorLog", "diagnostics": "DiagnosticsLog"}
"""Files whose records are counted."""

REJECTED_WORDS = {
    Rejected.DAY_OFF: "timestamp more than a day off",
    Rejected.CLOCKS_DISAGREE: "device and PC clock disagree by more than 2 s",
    Rejected.DUPLICATE: "the same packet twice",
    Rejected.STEPS_BACK: "PacketGenTime steps back",
}
"""Why packets were left out, in words."""


class _Stream(Protocol):
    @property
    def headers(self) -> PacketHeaders: ...
    @property
    def unusable(self) -> int: ...


def describe_quality(
    streams: Mapping[str, _Stream], times: Mapping[str, PacketTimes], counts: Mapping[str, int], report: Callable[[str], FileReport]
) -> dict[str, Any]:
    """Packets, loss and chunks per stream that was placed in time, and what else says how far the recording can be trusted.

    Args:
        streams: by name. times: of the streams with packets, by name.
        counts: records of the error and diagnostics logs.
        report: of a file, by its name without ending; sentences are added to it.
    """
    quality: dict[str, Any] = {name: _packets(streams[name], t, report(STEMS[name])) for name, t in times.items()}
    for name, data in streams.items():
        if name not in times and data.unusable:
            report(STEMS[name]).repaired.append(_left_out(data.unusable))
    td = streams.get("time_domain")
    if isinstance(td, TimeDomain) and "time_domain" in quality:
        quality["time_domain"]["flat_share"] = {f"key {k}": round(flat_share(x), 4) for k, x in enumerate(td.samples) if x.size}
        if lost := sum(int(np.isnan(x).sum()) for x in td.samples):
            report("RawDataTD").repaired.append(f"{lost} samples that are no finite number became gaps")
    power = streams.get("power")
    if isinstance(power, Power) and power.over_range:
        report("RawDataPower").flagged.append(f"{power.over_range} packets over range: gaps")
        quality.setdefault("power", {})["over_range"] = power.over_range
    sync = streams.get("time_sync")
    if isinstance(sync, TimeSync) and "time_sync" in quality:
        quality["time_sync"] |= _clocks(sync)
    for name, count in counts.items():
        quality[name] = count
        if count and name == "errors":
            report(COUNTED[name]).flagged.append(f"the device reported {count} error{'s' if count != 1 else ''}")
    return quality


def _packets(data: _Stream, t: PacketTimes, said: FileReport) -> dict[str, Any]:
    if t.missing:
        said.flagged.append(f"{100 * t.loss:.1f} % of the packets are missing ({t.missing}); {t.chunks} stretches without a gap")
    said.repaired.extend(f"{count} packet{'s' if count != 1 else ''} left out: {REJECTED_WORDS[why]}" for why, count in t.rejected.items())
    if t.reordered:
        said.repaired.append(f"{t.reordered} packet{'s' if t.reordered != 1 else ''} out of order put in the order of the device's clock")
    if data.unusable:
        said.repaired.append(_left_out(data.unusable))
    if t.device_clock:
        said.flagged.append("no packet has a PacketGenTime: placed by the device's clock and the times of arrival")
    return {
        "packets": int(data.headers.size),
        "missing": t.missing,
        "loss": round(t.loss, 4),
        "chunks": t.chunks,
        "rejected": {why.value: count for why, count in t.rejected.items()},
        "reordered": t.reordered,
        "unusable": data.unusable,
    }


def _left_out(count: int) -> str:
    return f"{count} packet{'s' if count != 1 else ''} left out: fields missing or of the wrong kind"


def _clocks(sync: TimeSync) -> dict[str, float | None]:
    """Median latency of the clock exchanges, and how fast the device's clock runs against the PC's, in parts per million."""
    latency = sync.latency_ms[np.isfinite(sync.latency_ms)]
    drift = device_clock_drift(sync.headers)
    return {
        "latency_median_ms": round(float(np.median(latency)), 3) if latency.size else None,
        "clock_drift_ppm": None if drift is None else round(1e6 * drift, 2),
    }
