"""Percept session reports (JSON): streaming runs, surveys and the history that the device keeps. Source: format notes, A′.

Each streaming run gives one recording per side of the brain, on the common grid of steps. It has `beta` from the samples (`time_domain`),
the device's `band_power` (`percept_lfp`) and the `amplitude`. The recordings of one run carry the same `run`, and belong to one session.
Runs are paired by ticks, channel and FirstPacketDateTime, which is on the implant's clock (`clock.py`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.archive import READ_ERRORS, Files, ZipFiles, told
from ml.formats.beta import channel_spectrum, step_trace, time_domain_traces
from ml.formats.options import DecodeOptions
from ml.formats.percept import details
from ml.formats.percept.annotations import gather
from ml.formats.percept.clock import describe_clock, implant_clock, to_utc
from ml.formats.percept.dose import cycling, describe_cycling, groups_used, leads_of
from ml.formats.percept.enums import word
from ml.formats.percept.history import history_recording
from ml.formats.percept.report_json import SIDES, entries, inside, looks_like_report, read_report, side_of, utc_offset_h
from ml.formats.percept.runs import Run, pair_runs
from ml.formats.percept.streams import DevicePower, Side, TimeDomain, device_powers, time_domains
from ml.formats.recording import DecodedFile, EventLog, FileReport, RecordingLog, SampleLog, TraceLog, UndecodableFile, fingerprint
from ml.signals import interval_means


def decode_percept(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a session report, or a zip of them.

    Raises:
        UndecodableFile: no report in it can be read; says why.
    """
    with path.open("rb") as stream:
        zipped = stream.read(4) == b"PK\x03\x04"
    if not zipped:
        with path.open("rb") as stream:
            report = FileReport(name or path.name)
            return DecodedFile(decode_report(read_report(stream, report.repaired), report, options), (report,))
    recordings: list[RecordingLog] = []
    reports: list[FileReport] = []
    with ZipFiles(path, options.archive) as files:
        members = report_members(files, damaged=True)
        for number, member in enumerate(members, start=1):
            report = FileReport(name or path.name if len(members) == 1 else f"report {number}")
            reports.append(report)
            try:
                with files.open(member) as stream:
                    found = decode_report(read_report(stream, report.repaired), report, options, _next_run(recordings))
            except UndecodableFile as error:
                if len(members) == 1:
                    raise
                reports[-1] = FileReport(report.name, problem=error.stored)
                continue
            recordings.extend(found)
        others = len(files.names()) - len(members)
        if reports:
            reports[0].ignored.extend(told(files.left_out))
        if reports and others:
            reports[0].ignored.append(f"{others} file{'s' if others > 1 else ''} that are no session report")
    if not any(r.problem is None for r in reports):
        raise UndecodableFile("no Percept session report in here", "archive", "Zip the JSON files of the programmer.")
    return DecodedFile(tuple(recordings), tuple(reports))


def report_members(files: Files, *, damaged: bool = False) -> list[str]:
    """List members of an archive that begin like a session report; with `damaged` also JSON files that cannot be read, to report them."""
    out = []
    for member in files.names():
        try:
            with files.open(member) as stream:
                if looks_like_report(stream.read(65_536)):
                    out.append(member)
        except (UndecodableFile, *READ_ERRORS):
            if damaged and member.lower().endswith(".json"):
                out.append(member)
    return out


def _next_run(recordings: list[RecordingLog]) -> int:
    return 1 + max((r.run for r in recordings if r.run is not None), default=-1)


def decode_report(report: dict[str, Any], said: FileReport, options: DecodeOptions, first_run: int = 0) -> tuple[RecordingLog, ...]:
    """Decode the recordings of one report; the result of each section is added to `said`."""
    device = device_name(report)
    channels = time_domains("BrainSenseTimeDomain", report.get("BrainSenseTimeDomain"))
    runs = pair_runs(channels, device_powers(report.get("BrainSenseLfp")), said)
    packets = [run.first_packet for run in runs]
    clock = implant_clock(report, packets)
    utc = partial(to_utc, clock)
    describe_clock(clock, report, packets, said)
    recordings: list[RecordingLog] = []
    dated = details.dated_events(report, utc, gather(report).kept)
    for number, run in enumerate(runs):
        recordings += _run_recordings(run, number, first_run, report, said, options, dated, utc)
    if not runs:
        said.flagged.append("no streaming run (BrainSenseTimeDomain, BrainSenseLfp) in this report: nothing in it can be a session")
    recordings += _indefinite(report, said, options, utc)
    history = history_recording(report, said, options, dated, utc)
    recordings += [history] if history is not None else []
    if not recordings:
        said.flagged.append("a report without data: none of its sections holds samples, history or events")
    local = {"utc_offset_h": utc_offset_h(report.get("ProgrammerUtcOffset"))}
    return tuple(
        replace(r, device_key=device, settings={**r.settings, **local, "clock": clock.as_settings(r.started_at)}) for r in recordings
    )


def device_name(report: dict[str, Any]) -> str | None:
    """Read the serial number of the neurostimulator (or the pseudonym that replaced it); None where it was removed."""
    for part in ("Final", "Initial"):
        serial = inside(report, "DeviceInformation", part, "NeurostimulatorSerialNumber")
        if isinstance(serial, str) and serial.strip():
            return serial.strip()[:80]
    return None


def _run_recordings(
    run: Run,
    number: int,
    first_run: int,
    report: dict[str, Any],
    said: FileReport,
    options: DecodeOptions,
    dated: list[details.DatedEvent],
    utc: details.ToUtc,
) -> list[RecordingLog]:
    """Build one recording per side that streamed or was stimulated, with what was marked, noted and rated during the run."""
    begin, end = run.span_ms
    start = utc(run.first_packet) if run.first_packet else None
    noted = _noted_within(dated, start, (end - begin) / 1000.0)
    rows = math.ceil((end - begin) / 1000.0 / options.period_s - 1e-6)
    label = f"run {first_run + number + 1}"
    leads = {side_of(word(lead.get("Hemisphere"))) for lead in entries(inside(report, "LeadConfiguration", "Final"))}
    targets = leads_of(report)
    group = details.snapshot(run.power.snapshot, "left")["group"] if run.power is not None else None
    groups = groups_used(report, group, run.first_packet, (end - begin) / 1000.0)
    states = {g: state for g in groups if (state := cycling(report, g)) is not None}
    group = next((g for g, state in states.items() if state["enabled"]), group)
    cycles = states.get(group)
    unsteady = cycles is not None and cycles["enabled"] and run.power is not None
    out = []
    for side in (*SIDES, None):
        channels = [c for c in run.channels if c.side == side]
        traces = [t for c in channels for t in _beta(c, begin, rows, options)]
        driven = False
        if run.power is not None and side is not None:
            traces += _power_traces(run.power, side, begin - run.power_origin_ms, rows, options)
            driven = bool(np.nanmax(run.power.amplitude_ma[side], initial=0.0) > 0)
        sensed = bool(channels) or any(t.stream == "band_power" for t in traces)
        if unsteady:
            traces = [_unknown_amplitude(t) if t.stream == "amplitude" else t for t in traces]
        # the amplitude of a side without a lead is a row of zeros that means nothing
        if not (sensed or driven or (traces and side in leads)):
            continue
        one = _recording(run, side, channels, traces, begin, end, first_run + number, options)
        known: dict[str, Any] = {"leads": [targets[side]]} if side in targets else {}
        known |= {"cycling": cycles} if cycles is not None else {}
        out.append(replace(one, events=noted, started_at=start, settings={**one.settings, **known}))
        _describe(said, label, side, channels, traces, (end - begin) / 1000.0)
    for note in dict.fromkeys(n for c in run.channels for n in c.notes):
        said.repaired.append(f"{label}: {note}")
    if unsteady and cycles is not None and out:
        said.flagged.append(f"{label}: {describe_cycling(cycles, group)}")
    for note in run.power.notes if run.power else ():
        said.repaired.append(f"{label}: {note}")
    for note in run.power.void if run.power else ():
        said.flagged.append(f"{label}, {note}")
    _check_lengths(run, label, said)
    return out


def _unknown_amplitude(trace: TraceLog) -> TraceLog:
    """Take the values out of an amplitude that was not delivered all the time."""
    none, invalid = np.full_like(trace.values, np.nan), np.zeros_like(trace.valid)
    return replace(trace, values=none, valid=invalid, details={**trace.details, "cycling": True})


def _noted_within(dated: list[details.DatedEvent], start: datetime | None, length_s: float) -> tuple[EventLog, ...]:
    """Select events of people within a run, in seconds of it; none where the run has no date. What the device logs stays in its history."""
    if start is None:
        return ()
    end = start + timedelta(seconds=length_s)
    return details.as_events((e for e in dated if e[1] != "device" and start <= e[0] <= end), start)


def _beta(channel: TimeDomain, begin: float, rows: int, options: DecodeOptions) -> list[TraceLog]:
    said = {"contacts": channel.channel, "section": channel.section}
    return time_domain_traces(channel.stretches(begin), channel.channel, rows, options, said)


def _power_traces(power: DevicePower, side: Side, begin_ms: float, rows: int, options: DecodeOptions) -> list[TraceLog]:
    """Make traces of the device's band power of a sensed side, and of its amplitude. The run begins `begin_ms` after the first interval
    does."""
    t_s = (power.ticks_ms - (power.ticks_ms[0] - power.interval_ms) - begin_ms) / 1000.0
    interval_s = power.interval_ms / 1000.0
    out = []
    channel = power.channel_of(side)
    if channel is not None and np.isfinite(power.power[side]).any():
        means, covered = interval_means(t_s, power.power[side], interval_s, rows, options.period_s)
        set_to = details.snapshot(power.snapshot, side)
        said = {"sensing_frequency_hz": set_to["sensing_frequency_hz"], "averaging_ms": set_to["averaging_ms"]}
        out.append(step_trace(("band_power", channel, "device units"), "percept_lfp", means, covered, options, said))
    if np.isfinite(power.amplitude_ma[side]).any():
        means, covered = interval_means(t_s, power.amplitude_ma[side], interval_s, rows, options.period_s)
        out.append(step_trace(("amplitude", side, "mA"), "device_log", means, covered, options, {"origin": "BrainSenseLfp"}))
    return out


def _recording(
    run: Run, side: Side | None, channels: list[TimeDomain], traces: list[TraceLog], begin: float, end: float, number: int | None,
    options: DecodeOptions,
) -> RecordingLog:  # fmt: skip
    power = run.power
    quality: dict[str, Any] = {
        "valid_fraction": {f"{t.stream} {t.channel}": round(float(t.valid.mean()), 4) for t in traces if t.valid.size}
    }
    quality["time_domain"] = {
        c.channel: {
            "samples": int(c.values.size),
            "missing_samples": c.lost,
            "loss": round(c.lost / (c.lost + c.values.size), 6),
            "rate_hz": c.rate_hz,
            "loss_visible": c.ticked,
        }
        for c in channels
    }
    settings: dict[str, Any] = {"period_s": options.period_s, "section": channels[0].section if channels else "BrainSenseLfp"}
    settings["first_tick_ms"] = float(begin)
    if power is not None and side is not None:
        settings["therapy"] = details.snapshot(power.snapshot, side)
    return RecordingLog(
        kind="percept",
        device_key=None,
        hemisphere=side,
        clock="device",
        started_at=run.first_packet,
        duration_s=round((end - begin) / 1000.0, 4),
        traces=tuple(traces),
        events=(),
        limits=details.limits(power.snapshot, side) if power is not None and side is not None else {},
        settings=settings,
        quality=quality,
        fingerprint=_fingerprint(run, side, channels),
        spectra=tuple(s for c in channels for s in channel_spectrum(c.stretches(begin), c.channel)),
        run=number,
        samples=tuple(SampleLog.of(c.channel, "uV", c.stretches(begin)) for c in channels) if options.keep_samples else (),
    )


def _fingerprint(run: Run, side: Side | None, channels: list[TimeDomain]) -> str:
    parts: list[str | bytes | NDArray[Any]] = [str(run.first_packet), str(side)]
    for channel in channels:
        parts += [channel.section, channel.channel, channel.values, repr(channel.pieces)]
    if run.power is not None and side is not None:
        parts += [run.power.ticks_ms, run.power.power[side], run.power.amplitude_ma[side]]
    return fingerprint("percept", parts)


def _describe(
    said: FileReport, label: str, side: Side | None, channels: list[TimeDomain], traces: list[TraceLog], length_s: float
) -> None:  # fmt: skip
    """Describe each side of a run in one sentence."""
    parts = [f"{c.channel}: {c.values.size} samples at {c.rate_hz:g} Hz" for c in channels]
    parts += [f"power of {t.channel}" for t in traces if t.stream == "band_power"]
    parts += ["amplitude" for t in traces if t.stream == "amplitude"]
    said.understood.append(f"{label}, {side or 'side unknown'}: {length_s:.1f} s, {', '.join(parts)}")
    for c in channels:
        said.flagged.extend(f"{label}, {c.channel}: {loss}" for loss in c.losses())
        if not c.ticked:
            said.flagged.append(f"{label}, {c.channel}: no ticks, so lost samples cannot be seen")
        if not any(t.channel == c.channel and t.source == "time_domain" for t in traces):
            said.flagged.append(f"{label}, {c.channel}: sampled too slowly for the beta band; left out")
    if channels and not any(t.stream == "amplitude" for t in traces):
        said.flagged.append(f"{label}, {side or 'side unknown'}: no amplitude was logged with it")


def _check_lengths(run: Run, label: str, said: FileReport) -> None:
    for c in run.channels:
        if c.ticked and abs((c.end_ms - c.begin_ms) / 1000.0 - (c.values.size + c.lost) / c.rate_hz) > 1.0:
            said.flagged.append(f"{label}, {c.channel}: ticks and number of samples disagree by more than 1 s")


def _indefinite(report: dict[str, Any], said: FileReport, options: DecodeOptions, utc: details.ToUtc) -> list[RecordingLog]:
    """Build recordings of indefinite streaming: up to six channels, no amplitude, so beta and spectra and no session."""
    runs = pair_runs(time_domains("IndefiniteStreaming", report.get("IndefiniteStreaming")), [], said)
    out = []
    targets = leads_of(report)
    for run in runs:
        begin, end = run.span_ms
        start = utc(run.first_packet) if run.first_packet else None
        rows = math.ceil((end - begin) / 1000.0 / options.period_s - 1e-6)
        for side in (*SIDES, None):
            channels = [c for c in run.channels if c.side == side]
            traces = [t for c in channels for t in _beta(c, begin, rows, options)]
            if channels:
                one = _recording(run, side, channels, traces, begin, end, None, options)
                known = {"leads": [targets[side]]} if side in targets else {}
                out.append(replace(one, started_at=start, settings={**one.settings, **known}))
    if runs:
        count = sum(len(r.channels) for r in runs)
        kept = "beta and spectra kept, no session, because no amplitude is logged with it"
        said.understood.append(f"IndefiniteStreaming: {len(runs)} runs, {count} channels; {kept}")
        said.repaired.extend(dict.fromkeys(f"IndefiniteStreaming: {n}" for r in runs for c in r.channels for n in c.notes))
        said.flagged.extend(f"IndefiniteStreaming, {c.channel}: {loss}" for r in runs for c in r.channels for loss in c.losses())
    return out
