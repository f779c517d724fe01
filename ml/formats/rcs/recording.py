"""One RC+S recording from its decoded streams: the common grid, traces, events, limits, quality and fingerprint."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.beta import FLAT_S, LARGEST_UV
from ml.formats.disagreements import CONFLICTS, disagreement
from ml.formats.dose import Dose
from ml.formats.options import DecodeOptions
from ml.formats.rcs.amplitude import AmplitudeSteps, amplitude_steps
from ml.formats.rcs.beta import (
    Stretch,
    beta_traces,
    flat_samples,
    impossible_samples,
    time_domain_samples,
    time_domain_spectra,
    time_domain_stretches,
)
from ml.formats.rcs.events import adaptive_events, note_events, stimulation_events
from ml.formats.rcs.leads import described, hemisphere
from ml.formats.rcs.packets.headers import PacketHeaders
from ml.formats.rcs.packets.streams import Accel, Adaptive, Fft, Power, TimeDomain, TimeSync
from ml.formats.rcs.packets.time import PacketTimes, RecordingTimes, reconstruct_all
from ml.formats.rcs.quality import STEMS, describe_clock, describe_quality
from ml.formats.rcs.settings import GROUPS, Settings, Therapy, dose_of, get, integer, limits_of, number
from ml.formats.rcs.traces import Grid, accel_traces, amplitude_traces, fft_results, power_traces
from ml.formats.recording import FileReport, Hemisphere, RecordingLog, SpectrumLog, TraceLog, fingerprint
from ml.formats.vouching import Disagreement

MAX_ROWS = 100_000
"""Rows a recording may have (55 h of 2 s steps): clocks that span more are wrong."""

MAX_CONFLICTS = 10
"""As many contradictions between two sources are reported one by one."""

PRIMARY = ("time_domain", "power", "adaptive")
"""Streams that say what was recorded; the others matter for identity only where none of these is there."""

ReportOf = Callable[[str], FileReport]
Stream = TimeDomain | Power | Adaptive | Accel | Fft | TimeSync


@dataclass(slots=True)
class Streams:
    """Everything decoded from one device folder; a stream whose file is missing is None."""

    time_domain: TimeDomain | None
    power: Power | None
    adaptive: Adaptive | None
    accel: Accel | None
    fft: Fft | None
    time_sync: TimeSync | None
    settings: Settings
    notes: list[Any]
    infos: list[dict[str, Any]]
    counts: dict[str, int]

    def data(self) -> dict[str, Stream]:
        """Return the streams whose file is there, by name."""
        named: dict[str, Stream | None] = {name: getattr(self, name) for name in STEMS}
        return {name: data for name, data in named.items() if data is not None}

    def placed(self) -> tuple[RecordingTimes, Settings]:
        """Place all packets on one timeline, and bring the settings' PC times onto it."""
        times = reconstruct_all(self.headers(), {name: data.same for name, data in self.data().items()}, PRIMARY)
        return times, self.settings.at_times(times.clock.of_pc_ms)

    def headers(self) -> dict[str, PacketHeaders]:
        """Collect the headers of the streams that have packets."""
        return {name: data.headers for name, data in self.data().items() if data.headers.size}


def build_recording(streams: Streams, report: ReportOf, options: DecodeOptions) -> RecordingLog:
    """Put a recording together; ignored parts are named in the report of the file they come from."""
    timeline, settings = streams.placed()
    times = timeline.streams
    spans = _spans(streams.headers(), times, report, options)
    times = {name: t for name, t in times.items() if name in spans}
    main = {name: span for name, span in spans.items() if name in PRIMARY} or {n: s for n, s in spans.items() if n != "time_sync"}
    start_ms = min((span[0] for span in main.values()), default=_first_record_ms(streams.settings))
    end_ms = max((span[1] for span in main.values()), default=start_ms)
    duration_s = (end_ms - start_ms) / 1000.0
    grid = Grid(start_ms, duration_s, max(0, math.ceil(duration_s / options.period_s - 1e-6)), options)
    steps = amplitude_steps(settings, streams.adaptive if "adaptive" in times else None, times.get("adaptive"))
    for begin_ms, until_ms in timeline.clock.doubtful_ms(streams.settings.record_times_ms):
        steps = steps.unknown_within(begin_ms, until_ms)
        since_s, until_s = max(0.0, begin_ms - start_ms) / 1000.0, (until_ms - start_ms) / 1000.0
        if math.isinf(until_ms):
            said = f"the computer's clock was set back, so that changes have no order: the amplitude is unknown from {since_s:.0f} s on"
        else:
            said = f"the computer's clock was set while packets were lost: the amplitude is unknown from {since_s:.0f} to {until_s:.0f} s"
        report("StimLog").flagged.append(said)
    channels: dict[str, list[Stretch]] = {}
    if main and streams.time_domain is not None and "time_domain" in times:
        channels = time_domain_stretches(streams.time_domain, times["time_domain"], settings)
        if absurd := impossible_samples(streams.time_domain):
            report("RawDataTD").flagged.append(f"{absurd} samples beyond {LARGEST_UV / 1000:g} mV, which no electrode gives: gaps")
        if flat := flat_samples(streams.time_domain):
            report("RawDataTD").flagged.append(f"{flat} samples stand still for {FLAT_S:g} s or longer, as no electrode does: gaps")
    traces, spectra = _traces(streams, settings, times, steps, grid, channels, report) if main else ([], [])
    if not main:
        report("RawDataTD").flagged.append("a recording without data: no stream holds a packet that can be placed in time")
    quality = describe_quality(streams.data(), times, settings, streams.counts, report)
    if timeline.streams:
        quality["clock"] = describe_clock(timeline, start_ms, report)
    quality[CONFLICTS] = [_disagreement(c, grid) for c in settings.conflicts]
    quality["valid_fraction"] = {f"{t.stream} {t.channel}": round(float(t.valid.mean()), 4) for t in traces if t.valid.size}
    quality["spike_packets"] = {t.channel: t.details["spike_packets"] for t in traces if t.details.get("spike_packets")}
    device_clock = bool(main) and all(times[name].device_clock for name in main)
    started = None if start_ms <= 0 else datetime.fromtimestamp(start_ms / 1000.0, UTC)
    events = [*stimulation_events(settings, grid), *note_events(streams.notes, steps, grid, timeline.clock.of_pc_ms)]
    if streams.adaptive is not None and "adaptive" in times:
        events += adaptive_events(streams.adaptive, times["adaptive"], grid)
    return RecordingLog(
        kind="rcs",
        device_key=_text(streams.infos, "DeviceId"),
        hemisphere=_hemisphere(streams, report),
        clock="device" if device_clock else "pc",
        started_at=started,
        duration_s=round(duration_s, 4),
        traces=tuple(traces),
        events=tuple(sorted(events, key=lambda event: event.t_s)),
        limits=_limits(streams.settings),
        settings=_summary(settings, grid),
        quality=quality,
        fingerprint=_fingerprint(streams),
        spectra=tuple(spectra),
        samples=tuple(time_domain_samples(channels, grid)) if options.keep_samples else (),
    )


def _hemisphere(streams: Streams, report: ReportOf) -> Hemisphere | None:
    """Find the side that the leads behind the sensed channels share, where the settings name it."""
    subject = get(streams.settings.merged, "SubjectInfo")
    keys: set[int] = set()
    if streams.time_domain is not None:
        keys |= {key for key, x in enumerate(streams.time_domain.samples) if x.size}
    if streams.power is not None and streams.power.bands.size:
        keys |= {i // 2 for i in range(8) if np.isfinite(streams.power.bands[:, i]).any()}
    side = hemisphere(subject, keys)
    if side is not None:
        report("DeviceSettings").understood.append(f"leads on the {side} side")
    elif any(described(subject)):
        report("DeviceSettings").flagged.append("the leads of the sensed channels have no common side: name the hemisphere with the upload")
    return side


def _spans(
    headers: dict[str, PacketHeaders], times: dict[str, PacketTimes], report: ReportOf, options: DecodeOptions
) -> dict[str, tuple[float, float]]:
    """Find the beginning and end of each stream, PC ms; a stream impossibly far from the longest one is ignored and reported."""
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


def _first_record_ms(settings: Settings) -> float:
    known = [*settings.sensing.times_ms[:1], *settings.therapy.times_ms[:1]]
    return min(known, default=0.0)


def _traces(
    streams: Streams,
    settings: Settings,
    times: dict[str, PacketTimes],
    steps: AmplitudeSteps,
    grid: Grid,
    channels: dict[str, list[Stretch]],
    report: ReportOf,
) -> tuple[list[TraceLog], list[SpectrumLog]]:
    traces = beta_traces(channels, grid, report("RawDataTD").flagged)
    spectra = list(time_domain_spectra(channels))
    if streams.power is not None and "power" in times:
        traces += power_traces(streams.power, times["power"], settings, grid, report("RawDataPower").flagged)
    if streams.fft is not None and "fft" in times:
        fft_traces, fft_spectra = fft_results(streams.fft, times["fft"], settings, grid)
        traces, spectra = traces + fft_traces, spectra + fft_spectra
    if streams.accel is not None and "accel" in times:
        traces += accel_traces(streams.accel, times["accel"], grid)
    amplitude = amplitude_traces(steps, grid)
    if not amplitude:
        report("StimLog").flagged.append("no enabled program known: the recording has no amplitude trace")
    if steps.assumed_program and steps.from_adaptive:
        report("StimLog").flagged.append("no settings say which programs are enabled: program 0 is taken to be the one that stimulates")
    _tell_dose(settings, grid, report)
    return traces + amplitude, spectra


def _tell_dose(settings: Settings, grid: Grid, report: ReportOf) -> None:
    """Report where and why the delivered amplitude is unknown, or differs from the one that was set."""
    about = report("StimLog" if settings.stim_log else "DeviceSettings").flagged
    if settings.lost:
        about.append("records are lost: the amplitude is unknown from the last one before the loss until a source states it again")
    for said in dict.fromkeys(why for state in settings.therapy.states if state != Therapy() for why in dose_of(state).why):
        about.append(said)
    for one in settings.conflicts[:MAX_CONFLICTS]:
        both = [f"{_milliamps(one.logged[-1][1])} and DeviceSettings {_milliamps(one.read)}"] if one.logged else []
        at = (one.at_ms - grid.start_ms) / 1000.0
        about += [f"at {at:.1f} s StimLog says {each}: the amplitude is unknown there until a person chooses" for each in both]
    if (more := len(settings.conflicts) - MAX_CONFLICTS) > 0:
        about.append(f"StimLog and DeviceSettings differ at {more} further moments")


def _disagreement(one: Disagreement, grid: Grid) -> dict[str, Any]:
    """Describe two doses of one time, as `disagreement` does."""

    def s(t_ms: float) -> float:
        return min(max(0.0, (t_ms - grid.start_ms) / 1000.0), grid.end_s) if math.isfinite(t_ms) else grid.end_s

    ends = [*(t for t, _ in one.logged), one.end_ms][1:]
    logged = [(s(begin), s(end), dose) for (begin, dose), end in zip(one.logged, ends, strict=True)]
    sources = {"StimLog": logged, "DeviceSettings": [(s(one.at_ms), s(one.end_ms), one.read)]}
    programs = sorted({p for pieces in sources.values() for _, _, dose in pieces for p in dose.programs})
    stated = {
        name: {f"program {p}": [(a, b, dose.amplitude_ma[p]) for a, b, dose in pieces] for p in programs}
        for name, pieces in sources.items()
    }
    return disagreement(s(one.begin_ms), s(one.end_ms), stated)


def _milliamps(dose: Dose) -> str:
    return " + ".join(f"{dose.amplitude_ma[p]:g} mA" for p in dose.programs) or "0 mA"


def _limits(settings: Settings) -> dict[str, Any]:
    """List the clinician's amplitude limits of enabled programs, mA, by group and program."""
    limits: dict[str, Any] = {}
    for group in range(4):
        for p in range(4):
            if integer(get(settings.merged, f"TherapyConfigGroup{group}", "programs", p, "isEnabled")) != 0:
                continue
            if (bounds := limits_of(settings.merged, group, p)) is not None:
                limits.setdefault(f"group {GROUPS[group]}", {})[f"program {p}"] = {"lower_ma": bounds[0], "upper_ma": bounds[1]}
    return limits


def _summary(settings: Settings, grid: Grid) -> dict[str, Any]:
    """Summarise what sensing and detection were set to, in plain values."""
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
        "leads": described(get(settings.merged, "SubjectInfo")),
        "sensing": sensing,
        **({"battery": battery} if (battery := _battery(settings)) else {}),
    }


def _battery(settings: Settings) -> dict[str, float]:
    """Read the charge of the stimulator's battery in percent and its voltage in V, from its last settings of the recording."""
    state = get(settings.merged, "BatteryStatus")
    percent, millivolts = number(get(state, "batteryLevelPercent")), number(get(state, "batteryVoltage"))
    found = {"percent": percent, "voltage_v": None if millivolts is None else millivolts / 1000.0}
    likely = {"percent": (0.0, 100.0), "voltage_v": (0.5, 10.0)}
    return {name: value for name, value in found.items() if value is not None and likely[name][0] <= value <= likely[name][1]}


def _text(infos: list[dict[str, Any]], key: str) -> str | None:
    return next((info[key][:80] for info in infos if isinstance(info.get(key), str) and info[key]), None)


def _fingerprint(streams: Streams) -> str:
    """Compute the fingerprint of packets, settings times and stimulation; without the device's name and anything else that redaction
    changes."""
    parts: list[str | bytes | NDArray[Any]] = []
    headers = streams.headers()
    primary = {name: head for name, head in headers.items() if name in PRIMARY} or headers
    for name, head in sorted(primary.items()):
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
