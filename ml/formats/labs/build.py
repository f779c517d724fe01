"""Recordings, one per side, from the content of a lab's file."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.beta import LARGEST_UV, channel_spectrum, living, step_trace, time_domain_traces
from ml.formats.labs.content import Channel, Content, measured_samples
from ml.formats.labs.dose import amplitude_traces
from ml.formats.labs.marks import parse, render
from ml.formats.labs.meanings import explain, open_questions
from ml.formats.labs.names import UV
from ml.formats.options import DecodeOptions
from ml.formats.recording import EventLog, FileReport, Hemisphere, RecordingLog, SampleLog, TraceLog, UndecodableFile, fingerprint
from ml.formats.tables.cells.numbers import known_unit
from ml.signals import Stretch, row_means

MOST_CHANNELS = 64
MOST_MARKS = 10_000
MOST_ROWS = 100_000
HARMONICS = 20
"""Harmonics of the stimulation's rate that are looked at for aliases."""
LARGEST_RATE_HZ = 100_000.0


def recordings_of(content: Content, options: DecodeOptions, report: FileReport) -> tuple[RecordingLog, ...]:
    """Make one recording per side; they carry one `run`, and belong to one session.

    Raises:
        UndecodableFile: no channel of a local field potential in a known unit.
    """
    used = explain(content, options.meanings)
    chosen = _pairs(_usable(content, options, report), report)
    if not chosen:
        hint = (
            "Give channels names such as `LFP L 0-3` or the type LFP, and the unit uV, mV or V; or state the unit of LFP with the upload."
        )
        raise UndecodableFile("no channel of a local field potential in a known unit", "channels", hint)
    origin = min(c.timing.span_s[0] - 1.0 / c.timing.rate_hz for c in chosen)
    end = max(c.timing.span_s[1] - 1.0 / c.timing.rate_hz for c in chosen)
    rows = math.ceil((end - origin) / options.period_s - 1e-6)
    if rows > MOST_ROWS:
        what = f"its times span {(end - origin) / 3600:.0f} h, more than {MOST_ROWS * options.period_s / 3600:.0f} h"
        raise UndecodableFile(what, "time stamps", "Check the clock of the recording computer; upload one session per file.")
    sides: list[Hemisphere | None] = [side for side in ("left", "right", None) if any(c.name.side == side for c in chosen)]
    report.flagged.extend(dict.fromkeys(s for c in chosen for s in c.timing.sentences(c.shown)))
    _flag_aliases(content, chosen, options, report)
    questions = open_questions(content, used, origin)
    explanations = {"questions": questions, "meanings": used}
    if any(q["asked"] for q in questions):
        report.flagged.append("markers or channels of stimulation are not explained yet: state what they mean on the session's page")
    return tuple(
        _recording(content, side, [c for c in chosen if c.name.side == side], origin, end, rows, options, report, explanations)
        for side in sides
    )


def _usable(content: Content, options: DecodeOptions, report: FileReport) -> list[Channel]:
    """List channels of local field potentials with a unit; say why the others are not used."""
    out, without_unit, other = [], [], 0
    for channel in content.channels:
        if channel.name.kind == "other":
            other += 1
        elif channel.name.kind == "lfp" and channel.timing.pieces and channel.timing.rate_hz <= LARGEST_RATE_HZ:
            unit = channel.unit or known_unit(options.table_lfp_unit or "") or ""
            if unit in UV:
                out.append(replace(channel, unit=unit))
            else:
                without_unit.append(channel.shown)
    if without_unit:
        listed = ", ".join(without_unit[:5]) + (", …" if len(without_unit) > 5 else "")
        report.flagged.append(
            f"{len(without_unit)} channels without a known unit were left out ({listed}): state the unit of LFP with the upload"
        )
    if other:
        report.ignored.append(f"{other} channels that are no local field potential, amplitude or acceleration")
    if len(out) > MOST_CHANNELS:
        report.ignored.append(f"{len(out) - MOST_CHANNELS} channels beyond the first {MOST_CHANNELS}")
    return out[:MOST_CHANNELS]


def _pairs(channels: list[Channel], report: FileReport) -> list[Channel]:
    """Make pairs of single contacts of one lead, one and two contacts apart; a lead that has pairs already stays as it is."""
    out: list[Channel] = []
    leads: dict[tuple[str, int, str], list[Channel]] = defaultdict(list)
    for channel in channels:
        single = len(channel.name.contacts) == 1 and (channel.name.side is not None or channel.name.target)
        if single:
            leads[channel.name.lead, channel.group, channel.unit].append(channel)
        else:
            out.append(channel)
    for (lead, _, _), contacts in leads.items():
        if len({c.name.contacts for c in contacts}) != len(contacts):
            report.flagged.append(f"{lead}: two channels name the same contact, so no pairs were made of them")
            out += contacts
            continue
        near = [(a, b) for a, b in combinations(contacts, 2) if abs(a.name.contacts[0] - b.name.contacts[0]) <= 2]
        if not near or any(c.name.lead == lead and len(c.name.contacts) == 2 for c in out):
            out += contacts
            continue
        out += [_pair(a, b) for a, b in near]
        report.understood.append(f"{lead}: {len(contacts)} single contacts became {len(near)} pairs")
    return out


def _pair(a: Channel, b: Channel) -> Channel:
    if a.name.contacts > b.name.contacts:
        a, b = b, a
    contacts = (*a.name.contacts, *b.name.contacts)
    words = " ".join([*(w for w in (a.name.lead,) if w), f"+{contacts[0]}-{contacts[1]}"])
    return replace(a, name=replace(a.name, text=words, contacts=contacts), shown=words, read=lambda: a.read() - b.read())


def _stretches(channel: Channel, origin_s: float, report: FileReport) -> list[Stretch]:
    """List the gap-free stretches of a channel in uV; runs of zeros, no numbers and impossible values are gaps too."""
    x = channel.read() * UV[channel.unit]
    absurd = np.abs(x) > LARGEST_UV
    if absurd.mean() > 0.5:
        raise UndecodableFile(
            f"most samples are beyond {LARGEST_UV / 1e3:g} mV, more than any electrode in a brain gives",
            channel.shown,
            "Check the unit of the channel.",
        )
    good = measured_samples(x) & living(x, channel.timing.rate_hz) & ~absurd
    lost = sum(int((~good[p.begin : p.end]).sum()) for p in channel.timing.pieces)
    if lost:
        said = "are zero in a row, stand still, are no number or impossible: gaps. Were they recorded?"
        report.flagged.append(f"{channel.shown}: {lost} samples {said}")
    rate = channel.timing.rate_hz
    out: list[Stretch] = []
    for piece in channel.timing.pieces:
        inside = good[piece.begin : piece.end]
        if inside.all():
            out.append((piece.start_s - origin_s, rate, x[piece.begin : piece.end]))
            continue
        edges = np.flatnonzero(np.diff(np.concatenate(([0], inside.astype(np.int8), [0]))))
        for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            out.append((piece.start_s - origin_s + a / rate, rate, x[piece.begin + a : piece.begin + b]))
    return out


def _recording(
    content: Content,
    side: Hemisphere | None,
    channels: Sequence[Channel],
    origin: float,
    end: float,
    rows: int,
    options: DecodeOptions,
    report: FileReport,
    explanations: Mapping[str, Any],
) -> RecordingLog:
    traces: list[TraceLog] = []
    spectra, samples = [], []
    quality: dict[str, Any] = {"time_domain": {}, **explanations}
    parts: list[str | bytes | NDArray[Any]] = [str(content.start_at(origin)), str(side)]
    named = _distinct(channels, report)
    for shown, channel in named:
        stretches = _stretches(channel, origin, report)
        details = {"rate_hz": round(channel.timing.rate_hz, 6), "unit_in_file": channel.unit}
        found = time_domain_traces(stretches, shown, rows, options, details)
        if not found:
            report.flagged.append(f"{shown}: sampled too slowly for the beta band, or without a measured sample; left out")
        traces += found
        spectra += channel_spectrum(stretches, shown)
        parts += [shown, *(x for _, _, x in stretches), repr([s for s, _, _ in stretches])]
        if options.keep_samples:
            samples.append(SampleLog.of(shown, "uV", stretches))
        quality["time_domain"][shown] = {
            "samples": sum(x.size for _, _, x in stretches),
            "missing_samples": channel.timing.lost,
            "gaps": channel.timing.gaps,
            "rate_hz": round(channel.timing.rate_hz, 6),
            "jitter_s": round(channel.timing.jitter_s, 6),
        }
    if not any(t.stream == "beta" for t in traces):
        raise UndecodableFile("every channel is sampled too slowly for the beta band", "channels", "Upload the signal as it was recorded.")
    doses = amplitude_traces(content, origin, rows, side, options, report, quality)
    if not doses:
        report.flagged.append(
            f"{side or 'side unknown'}: no amplitude in the file: no policy can learn from this session until one is known"
        )
    # of what the file says: the same recording is known again whatever its markers are stated to mean
    parts += [repr([(round(m.t_s - origin, 6), m.label, m.duration_s) for m in content.marks])]
    parts += [np.concatenate([course.t_s - origin, course.values]) for course in content.courses]
    parts += [c.read() for c in content.channels if c.name.kind == "stimulation"]
    traces += [*doses, *_motion(content, origin, rows, options)]
    leads = sorted({c.name.lead for c in channels if c.name.target})
    started = content.start_at(origin)
    settings = {**content.settings, **content.clock_settings(started), "period_s": options.period_s, **({"leads": leads} if leads else {})}
    quality["valid_fraction"] = {f"{t.stream} {t.channel}": round(float(t.valid.mean()), 4) for t in traces if t.valid.size}
    length = end - origin
    report.understood.append(
        f"{side or 'side unknown'}: {length:.1f} s, {', '.join(f'{s} at {c.timing.rate_hz:.6g} Hz' for s, c in named[:6])}"
        + (f" and {len(named) - 6} more channels" if len(named) > 6 else "")
        + (", amplitude" if doses else "")
    )
    return RecordingLog(
        kind=content.kind,
        device_key=None,
        hemisphere=side,
        clock="pc",
        started_at=started,
        duration_s=round(length, 4),
        traces=tuple(traces),
        events=tuple(_events(content, side, origin)),
        limits={},
        settings=settings,
        quality=quality,
        fingerprint=fingerprint(content.kind, parts),
        spectra=tuple(spectra),
        samples=tuple(samples),
    )


def _distinct(channels: Sequence[Channel], report: FileReport) -> list[tuple[str, Channel]]:
    """Name channels; those of one name are numbered."""
    seen: dict[str, int] = defaultdict(int)
    out = []
    for channel in channels:
        seen[channel.shown] += 1
        out.append((channel.shown if seen[channel.shown] == 1 else f"{channel.shown} ({seen[channel.shown]})", channel))
    if twice := sorted(name for name, n in seen.items() if n > 1):
        report.flagged.append(f"{len(twice)} names of channels are there more than once ({', '.join(twice[:3])}): they were numbered")
    return out


def _events(content: Content, side: Hemisphere | None, origin: float) -> Iterator[EventLog]:
    """List the marks of a side as events."""
    for mark in sorted(content.marks, key=lambda m: m.t_s)[:MOST_MARKS]:
        found = mark.statement
        if found.side in (None, side):
            data = {"duration_s": mark.duration_s} if mark.duration_s else {}
            if found.mentions:
                data |= {"amplitude_ma": found.dose_ma} if found.dose_ma is not None else {}
            label = render(replace(parse(mark.label), words=""))
            yield EventLog(round(mark.t_s - origin, 4), "operator_note", label, data)


def _motion(content: Content, origin: float, rows: int, options: DecodeOptions) -> list[TraceLog]:
    """Compute root mean square acceleration per row and group of axes in one unit, each axis freed of its mean in the row."""
    groups: dict[tuple[int, str], list[Channel]] = defaultdict(list)
    for channel in content.channels:
        if channel.name.kind == "acceleration" and channel.unit in ("g", "m/s2") and channel.timing.pieces:
            groups[channel.group, channel.unit].append(channel)
    out = []
    for number, ((_, unit), axes) in enumerate(groups.items(), start=1):
        timing = axes[0].timing
        t_s = np.concatenate([p.start_s + np.arange(p.end - p.begin) / timing.rate_hz for p in timing.pieces]) - origin
        weight = np.full(t_s.size, 1.0 / timing.rate_hz)
        square, covered = np.zeros(rows), np.ones(rows)
        for axis in axes:
            x = axis.read()
            values = np.concatenate([x[p.begin : p.end] for p in timing.pieces])
            mean, share = row_means(t_s, values, weight, rows, options.period_s)
            second, _ = row_means(t_s, values**2, weight, rows, options.period_s)
            square += np.maximum(second - mean**2, 0.0)
            covered = np.minimum(covered, share)
        details = {"measure": f"rms of {len(axes)} axes without their mean"}
        names = ("acceleration", "sensor" if len(groups) == 1 else f"sensor {number}", unit)
        out.append(step_trace(names, "device_log", np.sqrt(square), covered, options, details))
    return out


def _flag_aliases(content: Content, channels: Sequence[Channel], options: DecodeOptions, report: FileReport) -> None:
    """Flag harmonics of the stated stimulation rate that a channel's sampling rate folds into the beta band. Nothing is removed."""
    stimulated = {r for m in content.marks if (r := m.statement.rate_hz)}
    for rate in sorted(stimulated):
        for fs in sorted({round(c.timing.rate_hz, 3) for c in channels}):
            folded = [(k, abs(k * rate - round(k * rate / fs) * fs)) for k in range(1, HARMONICS + 1)]
            inside = [(k, hz) for k, hz in folded if options.beta_low_hz <= hz <= options.beta_high_hz]
            if inside:
                k, hz = inside[0]
                said = f"harmonic {k} can appear at {hz:g} Hz, within the beta band; nothing was removed"
                report.flagged.append(f"stimulation at {rate:g} Hz sampled at {fs:g} Hz: {said}")
