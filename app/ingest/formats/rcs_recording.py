"""One RC+S recording from its decoded streams: the common grid, traces, events, limits, quality and fingerprint."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.ingest.formats.log import FileReport, RecordingLog, TraceLog, fingerprint
from app.ingest.formats.options import DecodeOptions
from app.ingest.formats.rcs_amplitude import AmplitudeSteps, amplitude_steps
from app.ingest.formats.rcs_events import adaptive_events, note_events, stimulation_events
from app.ingest.formats.rcs_settings import GROUPS, Settings, get, integer, number
from app.ingest.formats.rcs_streams import Adaptive, Power, TimeDomain
from app.ingest.formats.rcs_time import PacketHeaders, PacketTimes, reconstruct
from app.ingest.formats.rcs_traces import Grid, amplitude_traces, beta_traces, flat_share, power_traces

MAX_ROWS = 100_000
"""Rows a recording may have (55 h of 2 s steps): clocks that span more are wrong."""

STEMS = {"time_domain": "RawDataTD", "power": "RawDataPower", "adaptive": "AdaptiveLog"}
Report = Callable[[str], FileReport]


@dataclass(slots=True)
class Streams:
    """Everything decoded from one device folder; a stream whose file is missing is None."""

    time_domain: TimeDomain | None
    power: Power | None
    adaptive: Adaptive | None
    settings: Settings
    notes: list[Any]
    infos: list[dict[str, Any]]

    def headers(self) -> dict[str, PacketHeaders]:
        """Headers of the streams that hold packets."""
        named = {"time_domain": self.time_domain, "power": self.power, "adaptive": self.adaptive}
        return {name: data.headers for name, data in named.items() if data is not None and data.headers.size}


def build_recording(streams: Streams, report: Report, options: DecodeOptions) -> RecordingLog:
    """Put a recording together; what is left out is said in the report of the file it comes from."""
    times = {name: reconstruct(headers) for name, headers in streams.headers().items()}
    spans = _spans(streams.headers(), times, report, options)
    times = {name: t for name, t in times.items() if name in spans}
    start_ms = min((span[0] for span in spans.values()), default=_first_record_ms(streams))
    end_ms = max((span[1] for span in spans.values()), default=start_ms)
    duration_s = (end_ms - start_ms) / 1000.0
    grid = Grid(start_ms, duration_s, max(0, math.ceil(duration_s / options.period_s - 1e-6)), options)
    steps = amplitude_steps(streams.settings, streams.adaptive if "adaptive" in times else None, times.get("adaptive"))
    traces = _traces(streams, times, steps, grid, report) if spans else []
    if not spans:
        report("RawDataTD").flagged.append("a recording without data: no stream holds a packet that can be placed in time")
    quality = _quality(streams, times, report)
    quality["valid_fraction"] = {f"{t.stream} {t.channel}": round(float(t.valid.mean()), 4) for t in traces if t.valid.size}
    device_clock = bool(times) and all(t.device_clock for t in times.values())
    started = None if start_ms <= 0 else datetime.fromtimestamp(start_ms / 1000.0, UTC)
    events = [*stimulation_events(streams.settings, grid), *note_events(streams.notes, steps, grid)]
    if streams.adaptive is not None and "adaptive" in times:
        events += adaptive_events(streams.adaptive, times["adaptive"], grid)
    return RecordingLog(
        kind="rcs",
        device_key=_text(streams.infos, "DeviceId"),
        hemisphere=None,
        clock="device" if device_clock else "pc",
        started_at=started,
        duration_s=round(duration_s, 4),
        traces=tuple(traces),
        events=tuple(sorted(events, key=lambda event: event.t_s)),
        limits=_limits(streams.settings),
        settings=_summary(streams, grid),
        quality=quality,
        fingerprint=_fingerprint(streams),
    )


def _spans(
    headers: dict[str, PacketHeaders], times: dict[str, PacketTimes], report: Report, options: DecodeOptions
) -> dict[str, tuple[float, float]]:
    """Begin and end of each stream, PC ms; a stream that lies impossibly far from the longest one is left out and said."""
    spans: dict[str, tuple[float, float]] = {}
    limit_ms = 1000.0 * MAX_ROWS * options.period_s
    for name, head in headers.items():
        placed = np.isfinite(times[name].last_ms)
        if not placed.any():
            continue
        last = times[name].last_ms[placed]
        first = last - 1000.0 * head.samples[placed] / head.rate_hz[placed]
        spans[name] = (float(first.min()), float(last.max()))
    spans = {name: span for name, span in spans.items() if _plausible(span, limit_ms, report(STEMS[name]))}
    if spans:
        anchor = max(spans.values(), key=lambda span: span[1] - span[0])[0]
        far = [name for name, span in spans.items() if abs(span[0] - anchor) > limit_ms / 2]
        for name in far:
            report(STEMS[name]).flagged.append("its clock lies days away from the other streams; left out")
            del spans[name]
    return spans


def _plausible(span: tuple[float, float], limit_ms: float, report: FileReport) -> bool:
    if span[1] - span[0] <= limit_ms and 0 <= span[0] < 2.5e14:
        return True
    report.flagged.append("its packet times make no sense; left out")
    return False


def _first_record_ms(streams: Streams) -> float:
    known = [*streams.settings.sensing.times_ms[:1], *streams.settings.therapy.times_ms[:1]]
    return min(known, default=0.0)


def _traces(streams: Streams, times: dict[str, PacketTimes], steps: AmplitudeSteps, grid: Grid, report: Report) -> list[TraceLog]:
    traces: list[TraceLog] = []
    if streams.time_domain is not None and "time_domain" in times:
        traces += beta_traces(streams.time_domain, times["time_domain"], streams.settings, grid, report("RawDataTD").flagged)
    if streams.power is not None and "power" in times:
        traces += power_traces(streams.power, times["power"], streams.settings, grid, report("RawDataPower").flagged)
    amplitude = amplitude_traces(steps, grid)
    if not amplitude:
        report("StimLog").flagged.append("no enabled program known: the recording has no amplitude trace")
    if steps.assumed_program:
        report("StimLog").flagged.append("no settings say which programs are enabled: program 0 is taken to be the one that stimulates")
    return traces + amplitude


def _quality(streams: Streams, times: dict[str, PacketTimes], report: Report) -> dict[str, Any]:
    """Packets, loss and chunks per stream, also as sentences in the reports."""
    quality: dict[str, Any] = {}
    for name, t in times.items():
        data = getattr(streams, name)
        quality[name] = {
            "packets": int(data.headers.size),
            "missing": t.missing,
            "loss": round(t.loss, 4),
            "chunks": t.chunks,
            "rejected": dict(t.rejected),
            "unusable": data.unusable,
        }
        said = report(STEMS[name])
        if t.missing:
            said.flagged.append(f"{100 * t.loss:.1f} % of the packets are missing ({t.missing}); {t.chunks} stretches without a gap")
        said.repaired.extend(f"{count} packet{'s' if count != 1 else ''} left out: {why}" for why, count in t.rejected.items())
        if data.unusable:
            said.repaired.append(f"{data.unusable} packet{'s' if data.unusable != 1 else ''} left out: fields missing or of the wrong kind")
        if t.device_clock:
            said.flagged.append("no packet has a PacketGenTime: placed by the device's clock and the times of arrival")
    if streams.time_domain is not None and "time_domain" in quality:
        td = streams.time_domain
        quality["time_domain"]["flat_share"] = {f"key {k}": round(flat_share(x), 4) for k, x in enumerate(td.samples) if x.size}
        if lost := int(sum(np.isnan(x).sum() for x in td.samples)):
            report("RawDataTD").repaired.append(f"{lost} samples that are no finite number became gaps")
    if streams.power is not None and streams.power.over_range:
        report("RawDataPower").flagged.append(f"{streams.power.over_range} packets over range: gaps")
    return quality


def _limits(settings: Settings) -> dict[str, Any]:
    """Clinician's amplitude limits of enabled programs, mA, by group and program."""
    limits: dict[str, Any] = {}
    for group in range(4):
        for p in range(4):
            if integer(get(settings.merged, f"TherapyConfigGroup{group}", "programs", p, "isEnabled")) != 0:
                continue
            low = number(get(settings.merged, f"AmplitudeLimitsGroup{group}", f"prog{p}LowerInMilliamps"))
            high = number(get(settings.merged, f"AmplitudeLimitsGroup{group}", f"prog{p}UpperInMilliamps"))
            if low is not None and high is not None:
                limits.setdefault(f"group {GROUPS[group]}", {})[f"program {p}"] = {"lower_ma": low, "upper_ma": high}
    return limits


def _summary(streams: Streams, grid: Grid) -> dict[str, Any]:
    """What sensing and detection were set to, in plain values."""
    settings = streams.settings
    sensing = [
        {
            "from_s": round((t - grid.start_ms) / 1000.0, 3),
            "rates_hz": list(s.rates_hz),
            "contacts": list(s.contacts),
            "fft_interval_s": s.fft_interval_s,
            "fft_size": s.fft_size,
            "bands": [band.name if band is not None else None for band in s.bands],
            "sense_bits": s.sense_bits,
        }
        for t, s in zip(settings.sensing.times_ms, settings.sensing.states, strict=True)
    ]
    return {
        "period_s": grid.options.period_s,
        "utc_offset_h": number(get(settings.merged, "UtcOffset")),
        "adaptive_mode": integer(get(settings.merged, "AdaptiveConfig", "adaptiveMode")),
        "ld0_thresholds": [number(get(settings.merged, "DetectionConfig", "Ld0", "biasTerm", i)) for i in range(2)],
        "sensing": sensing,
    }


def _text(infos: list[dict[str, Any]], key: str) -> str | None:
    return next((info[key][:80] for info in infos if isinstance(info.get(key), str) and info[key]), None)


def _fingerprint(streams: Streams) -> str:
    """Over packets, settings times and stimulation; not over the device's name, nor anything that redaction changes."""
    parts: list[str | bytes | NDArray[Any]] = []
    for name, head in sorted(streams.headers().items()):
        parts += [name, head.seconds, head.tick, head.sequence, head.gen_ms, head.samples]
    if streams.time_domain is not None:
        parts += list(streams.time_domain.samples)
    if streams.power is not None:
        parts.append(streams.power.bands)
    if streams.adaptive is not None:
        parts.append(streams.adaptive.amplitude_ma)
    settings = streams.settings
    parts += [np.array(settings.sensing.times_ms), np.array(settings.therapy.times_ms), repr(settings.therapy.states)]
    parts.append(np.array(settings.record_times_ms))
    return fingerprint("rcs", parts)
