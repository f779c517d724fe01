"""Quality of an RC+S recording: packets, loss, chunks and clocks per stream, also as sentences in the reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ml.formats.rcs.beta import flat_share
from ml.formats.rcs.packets.headers import PacketHeaders
from ml.formats.rcs.packets.loss import Interval, loss_of
from ml.formats.rcs.packets.streams import Power, TimeDomain, TimeSync
from ml.formats.rcs.packets.time import LATE_MS, PacketTimes, RecordingTimes
from ml.formats.rcs.settings import Settings
from ml.formats.recording import FileReport
from ml.formats.rejection import REJECTED_WORDS, Rejected

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

SENSING_BITS = {"time_domain": 1, "fft": 2, "power": 4}
"""Bits of the sensing state with which a stream is on; the others run while any is set."""

RESIDUALS = 240
"""As many residuals of PacketGenTime are kept: the largest and the smallest of each of half as many pieces of the recording."""

WANDER_MS = 50.0


class _Stream(Protocol):
    @property
    def headers(self) -> PacketHeaders: ...
    @property
    def unusable(self) -> int: ...


def describe_quality(
    streams: Mapping[str, _Stream],
    times: Mapping[str, PacketTimes],
    settings: Settings,
    counts: Mapping[str, int],
    report: Callable[[str], FileReport],
) -> dict[str, Any]:
    """Describe packets, loss and chunks per stream that was placed in time, and what else shows how far the recording can be trusted.

    Args:
        streams: by name. times: of the streams with packets, by name.
        settings: on the timeline; they show when sensing was off.
        counts: records of the error and diagnostics logs.
        report: of a file, by its name without ending; sentences are added to it.
    """
    quality: dict[str, Any] = {
        name: _packets(streams[name], t, _switched_off(name, settings), report(STEMS[name])) for name, t in times.items()
    }
    for name, data in streams.items():
        if name not in times and data.unusable:
            report(STEMS[name]).flagged.append(_left_out(data.unusable))
    td = streams.get("time_domain")
    if isinstance(td, TimeDomain) and "time_domain" in quality:
        quality["time_domain"]["flat_share"] = {f"key {k}": round(flat_share(x), 4) for k, x in enumerate(td.samples) if x.size}
        if lost := sum(int(np.isnan(x).sum()) for x in td.samples):
            report("RawDataTD").flagged.append(f"{lost} samples that are no finite number became gaps")
    power = streams.get("power")
    if isinstance(power, Power) and power.over_range:
        report("RawDataPower").flagged.append(f"{power.over_range} packets over range: gaps")
        quality.setdefault("power", {})["over_range"] = power.over_range
    sync = streams.get("time_sync")
    if isinstance(sync, TimeSync) and "time_sync" in quality:
        quality["time_sync"]["latency_median_ms"] = _latency_ms(sync)
    for name, count in counts.items():
        quality[name] = count
        if count and name == "errors":
            report(COUNTED[name]).flagged.append(f"the device reported {count} error{'s' if count != 1 else ''}")
    return quality


def _switched_off(name: str, settings: Settings) -> list[Interval]:
    """Find when the settings show that a stream was off, ms of the timeline; nothing where they are silent."""
    bits = SENSING_BITS.get(name, 255)
    begins = settings.sensing.times_ms
    states = zip(begins, [*begins, np.inf][1:], settings.sensing.states, strict=True)
    return [(begin, end) for begin, end, state in states if state.sense_bits is not None and not state.sense_bits & bits]


def _packets(data: _Stream, t: PacketTimes, off: list[Interval], said: FileReport) -> dict[str, Any]:
    """Describe the received and the lost packets of one stream. Losses are flagged; repaired is only what was corrected without loss."""
    lost = loss_of(t.gaps, t.received_ms, off)
    if lost.missing_s > 0:
        said.flagged.append(
            f"{100 * lost.share:.1f} % of the signal is missing ({lost.missing_s:.1f} s; {_packets_word(lost.packets)} lost); "
            f"{t.chunks} stretches without a gap"
        )
    if lost.paused_s > 0:
        said.understood.append(f"sensing was switched off for {lost.paused_s:.1f} s in between: no loss")
    if twice := t.rejected.get(Rejected.DUPLICATE, 0):
        said.repaired.append(f"{_packets_word(twice)} left out: {REJECTED_WORDS[Rejected.DUPLICATE]}")
    said.flagged.extend(
        f"{_packets_word(count)} left out: {REJECTED_WORDS[why]}" for why, count in t.rejected.items() if why is not Rejected.DUPLICATE
    )
    if t.reordered:
        said.repaired.append(f"{_packets_word(t.reordered)} out of order put in the order of the device's clock")
    if t.moved:
        said.repaired.append(f"{_packets_word(t.moved)} under the clock of the next one put back before it")
    if t.late:
        said.flagged.append(f"{_packets_word(t.late)} arrived more than {LATE_MS / 1000:g} s later than usual")
    if data.unusable:
        said.flagged.append(_left_out(data.unusable))
    if t.device_clock:
        said.flagged.append("no packet has a PacketGenTime: placed by the device's clock and the times of arrival")
    return {
        "packets": int(data.headers.size),
        "missing": lost.packets,
        "missing_s": round(lost.missing_s, 3),
        "paused_s": round(lost.paused_s, 3),
        "loss": round(lost.share, 4),
        "chunks": t.chunks,
        "rejected": {why.value: count for why, count in t.rejected.items()},
        "reordered": t.reordered,
        "late": t.late,
        "moved": t.moved,
        "unusable": data.unusable,
    }


def _packets_word(count: int) -> str:
    return f"{count} packet{'s' if count != 1 else ''}"


def _left_out(count: int) -> str:
    return f"{count} packet{'s' if count != 1 else ''} left out: fields missing or of the wrong kind"


def _latency_ms(sync: TimeSync) -> float | None:
    """Compute the median latency of the clock exchanges, ms."""
    latency = sync.latency_ms[np.isfinite(sync.latency_ms)]
    return round(float(np.median(latency)), 3) if latency.size else None


def describe_clock(timeline: RecordingTimes, start_ms: float, report: Callable[[str], FileReport]) -> dict[str, Any]:
    """Compare the PC's clock with the implant's ticks for the session's page: drift, steps of either, and the residuals of PacketGenTime.

    Args:
        timeline: of all streams. start_ms: where the recording begins on it.
        report: of a file, by its name without ending; steps are reported in that of the stream with the most packets.
    """
    clock, streams = timeline.clock, timeline.streams
    main = max(streams, key=lambda name: streams[name].last_ms.size)
    pc_steps = list(zip(clock.timeline_ms(clock.steps_at_ms).tolist(), clock.steps_ms.tolist(), strict=True))
    for of, steps in (("the computer's", pc_steps), ("the implant's", timeline.implant_steps)):
        for at_ms, by_ms in steps:
            text = f"{of} clock was set by {by_ms / 1000:+.1f} s after {(at_ms - start_ms) / 1000:.1f} s; times follow the implant's ticks"
            if steps is pc_steps:
                # nothing in the file shows which of its two times was right
                report(STEMS[main]).flagged.append(f"{text}. The start is by one of its two times, and may be off by that")
            else:
                report(STEMS[main]).understood.append(text)
    at = np.concatenate([(t.last_ms - start_ms) / 1000.0 for t in streams.values()])
    residual = np.concatenate([t.residual_ms for t in streams.values()])
    known = np.flatnonzero(np.isfinite(at) & np.isfinite(residual))
    known = known[np.argsort(at[known], kind="stable")]
    shown = _extremes(residual[known])
    return {
        "drift_ppm": None if clock.drift is None else round(1e6 * clock.drift, 1),
        "pc_steps": [[round((t - start_ms) / 1000.0, 3), round(by / 1000.0, 3)] for t, by in pc_steps],
        "implant_steps": [[round((t - start_ms) / 1000.0, 3), round(by / 1000.0, 3)] for t, by in timeline.implant_steps],
        "residual_sd_ms": round(float(residual[known].std()), 2) if known.size else None,
        "residual_beyond_50_ms": round(float(np.mean(np.abs(residual[known]) > WANDER_MS)), 4) if known.size else None,
        "residual_t_s": np.round(at[known][shown], 2).tolist(),
        "residual_ms": np.round(residual[known][shown], 1).tolist(),
    }


def _extremes(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Find the places of the smallest and the largest value in each of `RESIDUALS / 2` pieces; all where there are few."""
    if values.size <= RESIDUALS:
        return np.arange(values.size)
    pieces = np.array_split(np.arange(values.size), RESIDUALS // 2)
    return np.array(sorted({int(piece[pick(values[piece])]) for piece in pieces for pick in (np.argmin, np.argmax)}), dtype=np.int64)
