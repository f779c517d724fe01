"""Reader of an XDF file without identity: pyxdf gives samples and synchronised stamps; stretches and rates are found here.

pyxdf's own de-jittering spreads a gap over all stamps of a stream (1.17.5: one of less than 1 s or 500 samples), so it is off.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from ml.formats.labs.build import recordings_of
from ml.formats.labs.content import Channel, Content, Course, Floats
from ml.formats.labs.marks import Mark
from ml.formats.labs.motion import outcomes_of
from ml.formats.labs.names import channel_name
from ml.formats.labs.timing import of_stamps
from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, FileReport, UndecodableFile

LAST_CHUNK_S = 1.0
"""A file that was not closed may lack marks of its last second, which the recorder had not written yet."""


def decode_xdf(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode an XDF file that `redact_xdf` wrote.

    Raises:
        UndecodableFile: no channel of a local field potential, or pyxdf is not installed.
    """
    report = FileReport(name or path.name)
    content = read_xdf(path, report)
    recordings = recordings_of(content, options, report)
    return DecodedFile(recordings, (report,), outcomes_of(content, options.meanings, report))


def read_xdf(path: Path, report: FileReport) -> Content:
    """Read channels, courses and marks on the recorder's clock."""
    try:
        import pyxdf  # an extra: a process that reads no XDF does not load it
    except ImportError as error:
        what = "the package pyxdf, which reads XDF files, is not installed"
        raise UndecodableFile(what, "service", "Ask your administrator to install betaloop[recordings].") from error
    logging.getLogger("pyxdf").setLevel(logging.CRITICAL)
    streams, head = pyxdf.load_xdf(str(path), dejitter_timestamps=False, synchronize_clocks=True)
    content = Content("xdf", marks_pause=False)
    used = _on_one_clock([s for s in streams if len(s["time_stamps"])], report)
    if not used:
        raise UndecodableFile("no stream of this file has a sample", "streams", "Check that the streams were selected in the recorder.")
    for number, stream in enumerate(used):
        _take(content, stream, number, report)
    first = min(float(np.min(s["time_stamps"])) for s in used)
    content.started = _date(head, first, report)
    if content.started is not None and content.started[1].tzinfo is not None:
        content.clock_known = True
        offset = content.started[1].utcoffset()
        content.utc_offset_h = offset.total_seconds() / 3600 if offset is not None else None
    if any("footer" not in s for s in used):
        last = max(float(np.max(s["time_stamps"])) for s in used)
        content.cut_s = last - LAST_CHUNK_S
        report.flagged.append("the recorder did not close this file: it may have been longer, and its last second may lack markers")
    return content


def _on_one_clock(streams: list[dict[str, Any]], report: FileReport) -> list[dict[str, Any]]:
    """List streams on one clock. A stream without clock offsets among others that have them is on another computer's clock."""
    with_offsets = [s for s in streams if len(s["clock_times"])]
    if not with_offsets:
        if len(streams) > 1:
            report.flagged.append("no stream has clock offsets: their times are taken to be of one computer")
        return streams
    for stream in streams:
        if not len(stream["clock_times"]):
            report.flagged.append(
                f"{_text(stream, 'name')}: it has no clock offsets, so its times cannot be compared with the others; left out"
            )
    return with_offsets


def _take(content: Content, stream: Mapping[str, Any], number: int, report: FileReport) -> None:
    """Add the channels, the course or the marks of one stream."""
    stamps: Floats = np.asarray(stream["time_stamps"], dtype=np.float64)
    shown, kind, values = _text(stream, "name"), _text(stream, "type"), stream["time_series"]
    rate = float(_text(stream, "nominal_srate") or 0)
    if _text(stream, "channel_format") == "string":
        for t_s, texts in zip(stamps.tolist(), values, strict=True):
            content.marks += [Mark(t_s, text) for text in texts if text]
        return
    described = _channel_heads(stream)
    labels = [(_first(d, "label"), _first(d, "unit"), _first(d, "type")) for d in described]
    labels += [("", "", "")] * (values.shape[1] - len(labels))
    if rate <= 0:
        for i, (label, unit, _) in enumerate(labels):
            # a stream of one channel may be named alone
            named = channel_name(label or shown, kind)
            if named.kind == "stimulation":
                content.courses.append(Course(named, named.text or shown, unit, stamps, values[:, i].astype(np.float64)))
        return
    try:
        timing = of_stamps(stamps, rate)
    except ValueError:
        report.flagged.append(f"{shown}: fewer than two samples; left out")
        return
    if abs(timing.rate_hz / rate - 1) > 0.01:
        report.flagged.append(f"{shown}: it states {rate:g} Hz, its times give {timing.rate_hz:.6g} Hz, which was taken")
    for i, (label, unit, of_type) in enumerate(labels):
        named = channel_name(label, of_type or kind)
        text = named.text or label or f"{shown} channel {i + 1}"
        content.channels.append(Channel(named, text, unit, timing, _reader(values, i), number))


def _reader(values: np.ndarray[Any, Any], i: int) -> Any:
    return lambda: values[:, i].astype(np.float64)


def _channel_heads(stream: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    desc = stream["info"].get("desc", [None])[0]
    channels = desc.get("channels", [None])[0] if isinstance(desc, Mapping) else None
    found = channels.get("channel", []) if isinstance(channels, Mapping) else []
    return [c if isinstance(c, Mapping) else {} for c in found]


def _first(fields: Mapping[str, Any], name: str) -> str:
    values = fields.get(name) or [""]
    return str(values[0] or "")


def _text(stream: Mapping[str, Any], name: str) -> str:
    return _first(stream["info"], name)


def _date(head: Any, first_s: float, report: FileReport) -> tuple[float, datetime] | None:
    """Read when the recording began: the header's date, and the first stamp."""
    text = _first(head["info"], "datetime") if head else ""
    try:
        return first_s, datetime.fromisoformat(text.replace(" +", "+"))
    except ValueError:
        report.flagged.append("the file's header has no date: state the start with the upload")
        return None
