"""Reader of a BIDS folder without identity: each run by the reader of its data file, then channels, events and sidecar are applied."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ml.formats.archive import Files, ZipFiles
from ml.formats.bids.folder import Run, find_runs, members_of, read_json, read_tsv
from ml.formats.brainvision.files import find_parts, read_head, read_markers, read_text
from ml.formats.brainvision.read import read_brainvision
from ml.formats.edf.read import read_edf
from ml.formats.labs.build import recordings_of
from ml.formats.labs.content import Channel, Content
from ml.formats.labs.marks import UNCLEAR, Mark, parse
from ml.formats.labs.names import ChannelName, Side, channel_name
from ml.formats.labs.timing import Timing
from ml.formats.nwb.read import read_nwb
from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, FileReport, RecordingLog, UndecodableFile
from ml.formats.source import InMemory

EARLIEST = 1990
"""Dates before this year were shifted, to hide when the recording was."""
LFP = ("ECOG", "SEEG", "DBS", "LFP")
NEAR_S = 0.1
"""Onset and sample of an event may differ by so much."""
_SIDES: dict[str, Side] = {"L": "left", "R": "right"}


def decode_bids(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode the runs that `redact_bids` wrote; a run of no use is reported, and the others are decoded.

    Raises:
        UndecodableFile: no run is of use.
    """
    recordings: list[RecordingLog] = []
    reports, problems = [], []
    with ZipFiles(path, options.archive) as files:
        runs, _ = find_runs(files)
        for number, run in enumerate(runs):
            report = FileReport(f"run {number + 1}" if len(runs) > 1 else name or path.name)
            try:
                content = read_run(files, run, report)
                recordings += [replace(r, run=number) for r in recordings_of(content, options, report)]
            except UndecodableFile as problem:
                problems.append(problem)
                report = replace(report, problem=problem.stored)
            reports.append(report)
    if not recordings:
        raise problems[0]
    return DecodedFile(tuple(recordings), tuple(reports))


def read_run(files: Files, run: Run, report: FileReport) -> Content:
    """Read one run: its data file, and what the other files say of it."""
    content = _read_data(files, run, report)
    content.kind = "bids"
    _apply_channels(content, read_tsv(files, run.channels), report)
    _apply_sidecar(content, read_json(files, run.sidecars), report)
    if timing := _first(content):
        _apply_start(content, timing, [row["acq_time"] for row in read_tsv(files, run.scans)], report)
        _add_events(content, timing, read_tsv(files, run.events), report)
    return content


def _read_data(files: Files, run: Run, report: FileReport) -> Content:
    view = members_of(run, files)
    if run.kind == "brainvision":
        (part,) = find_parts(view)
        head = read_head(read_text(view, part.header))
        markers = read_markers(read_text(view, part.markers)) if part.markers else []
        with view.open(part.samples) as stream:
            return read_brainvision(stream.read(), head, markers, report)
    with view.open(run.data.path) as stream:
        raw = stream.read()
    if run.kind == "nwb":
        return read_nwb(InMemory(raw, "run"), report)
    # without a name once it is open: the reader maps it
    with tempfile.NamedTemporaryFile() as file:
        file.write(raw)
        file.flush()
        return read_edf(Path(file.name), report)


def _first(content: Content) -> Timing | None:
    """Find the field potential whose first sample is the earliest: events count from it."""
    timings = [c.timing for c in content.channels if c.timing.pieces and c.name.kind == "lfp"]
    return min(timings, key=lambda t: t.span_s[0]) if timings else None


def _apply_channels(content: Content, rows: Sequence[dict[str, str]], report: FileReport) -> None:
    """Apply types, units and sides of channels.tsv; channels that it calls bad are excluded."""
    left = list(rows)
    kept, bad, differ, notch = [], 0, 0, set()
    for channel in content.channels:
        row = next((r for r in left if _is_of(channel, r["name"])), None)
        if row is None:
            kept.append(channel)
            continue
        left.remove(row)
        if row["status"] == "bad":
            bad += 1
            continue
        unit = "" if row["units"] == "n/a" else row["units"]
        differ += bool(unit and channel.unit and unit != channel.unit)
        notch |= {row["notch"]} - {"n/a"}
        name = _apply_row(channel.name, row)
        kept.append(replace(channel, name=name, shown=name.text or channel.shown, unit=channel.unit or unit))
    content.channels = kept
    if bad:
        report.ignored.append(f"{bad} channels that channels.tsv calls bad")
    if differ:
        report.flagged.append(f"{differ} channels have another unit in channels.tsv than in the data file, whose own was taken")
    if notch:
        report.flagged.append(f"channels.tsv states a notch filter at {', '.join(sorted(notch))} Hz: the signal is not as it was recorded")


def _is_of(channel: Channel, label: str) -> bool:
    """Decide whether a row of channels.tsv is of a channel: their names are one, or that of the electrode is part of it."""
    key = channel_name(label).text or label
    return key in (channel.name.text, channel.shown) or channel.shown.endswith(f" {key}")


def _apply_row(name: ChannelName, row: dict[str, str]) -> ChannelName:
    """Apply type and side of a row to a channel's name."""
    if row["type"] in LFP:
        typed = channel_name(row["name"], "SEEG")
        name = typed if name.scalp and typed.text else replace(name, kind="lfp", scalp=False)
    elif row["type"] != "n/a" and name.kind == "lfp":
        name = replace(name, kind="other")
    side = _SIDES.get(row["hemisphere"])
    if side is None or name.side == side or name.kind != "lfp":
        return name
    if name.side is None:
        return replace(name, side=side, text=f"{side} {name.text}" if name.text else "")
    return replace(name, side=None)


def _apply_sidecar(content: Content, sidecar: dict[str, Any], report: FileReport) -> None:
    """Compare the sidecar with the data file. Raises UndecodableFile for epochs, and for gaps that the data file does not show."""
    timings = [c.timing for c in content.channels]
    kind, rate = sidecar.get("RecordingType"), sidecar.get("SamplingFrequency")
    hint = "Send the recording in its original format: EDF+D, BrainVision with its markers, or NWB."
    if kind == "epoched":
        raise UndecodableFile("the sidecar says that the recording is cut into epochs", "RecordingType", hint)
    if kind == "discontinuous" and timings and not any(t.gaps for t in timings):
        raise UndecodableFile("the sidecar says that the recording has gaps, and the data file shows none", "RecordingType", hint)
    if rate and timings and all(abs(t.rate_hz / rate - 1) > 0.01 for t in timings):
        report.flagged.append(f"the sidecar states {rate:g} Hz, the data file {timings[0].rate_hz:.6g} Hz, which was taken")
    if sidecar.get("SoftwareFilters") == "notch":
        report.flagged.append("the sidecar states a notch filter: the signal is not as it was recorded")
    if parameters := sidecar.get("ElectricalStimulationParameters"):
        report.flagged.append(f"the sidecar states stimulation ({parameters}) without a time: it was not taken for the amplitude")


def _apply_start(content: Content, timing: Timing, times: Sequence[str], report: FileReport) -> None:
    """Take the start from scans.tsv where the data file has none."""
    if not times:
        return
    date = datetime.fromisoformat(times[0])
    if date.year < EARLIEST:
        report.flagged.append("scans.tsv has a date that was shifted: state the start with the upload")
        return
    if content.started is None:
        content.started, content.clock_known = (timing.span_s[0], date), date.tzinfo is not None
        report.flagged[:] = [s for s in report.flagged if "state the start with the upload" not in s]
        return
    at, own = content.started
    plain = own.astimezone(UTC).replace(tzinfo=None) if date.tzinfo and own.tzinfo else own.replace(tzinfo=None)
    apart = abs((date.replace(tzinfo=None) - plain).total_seconds() - (timing.span_s[0] - at))
    if apart > 60:
        report.flagged.append(f"scans.tsv and the data file differ about the start by {apart:.0f} s: that of the data file was taken")


def _add_events(content: Content, timing: Timing, rows: Sequence[dict[str, str]], report: FileReport) -> None:
    """Add the marks of events.tsv. Where a row's sample contradicts its onset, the amplitude that it states is unknown."""
    begin, differ = timing.span_s[0], 0
    for row in rows:
        t_s = begin + float(row["onset"])
        duration = None if row["duration"] == "n/a" else float(row["duration"])
        label = row["trial_type"]
        if row["sample"] != "n/a" and parse(label).mentions and abs(_time_of(timing, int(float(row["sample"]))) - t_s) > NEAR_S:
            label, differ = f"{UNCLEAR} stim", differ + 1
        content.marks.append(Mark(t_s, label, duration, duration is not None))
    if differ:
        report.flagged.append(f"{differ} events have a sample that is not at their onset: the amplitude is unknown after them")


def _time_of(timing: Timing, sample: int) -> float:
    """Return the time of a sample of the file, s; beyond its end it follows the last piece."""
    piece = next((p for p in timing.pieces if sample < p.end), timing.pieces[-1])
    return piece.start_s + (sample - piece.begin) / timing.rate_hz
