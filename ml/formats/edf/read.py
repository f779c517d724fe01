"""Reader of an EDF, EDF+ or BDF file without identity. The times of an EDF+ come from the time-keeping annotation of every record."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ml.formats.edf.head import Annotation, Head, Signal, read_annotations, read_head
from ml.formats.labs.build import recordings_of
from ml.formats.labs.content import Channel, Content, Floats
from ml.formats.labs.marks import Mark
from ml.formats.labs.names import channel_name, clean_unit
from ml.formats.labs.timing import Piece, Timing, even, of_pieces
from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, FileReport

Records = NDArray[np.uint8]


def decode_edf(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode an EDF or BDF file that `redact_edf` wrote.

    Raises:
        UndecodableFile: no channel of a local field potential.
    """
    report = FileReport(name or path.name)
    return DecodedFile(recordings_of(read_edf(path, report), options, report), (report,))


def read_edf(path: Path, report: FileReport) -> Content:
    """Read channels and marks; 0 is the start that the header states."""
    with path.open("rb") as stream:
        head = read_head(stream.read(1 << 20))
    records: Records = np.memmap(path, np.uint8, "r", head.size)
    count = records.size // head.record_bytes
    records = records[: count * head.record_bytes].reshape(count, head.record_bytes)
    content = Content("edf")
    if head.started is not None and head.started.year > 1985:
        content.started = (0.0, head.started)
    else:
        report.flagged.append("the header has no date: state the start with the upload")
    onsets: Floats = np.arange(count, dtype=np.float64) * float(head.record_s)
    if head.plus:
        onsets = _take_annotations(content, records, head, report)
        even_s = onsets[0] + np.arange(count) * head.record_s
        if head.reserved[4:5] == "C" and np.any(np.abs(onsets - even_s) > 1e-3):
            report.flagged.append("the header says that the recording has no gap, its records say that it has: the records were believed")
    for i, signal in enumerate(head.signals):
        if signal.annotations or signal.samples == 0 or head.record_s <= 0:
            continue
        low, high = signal.digital
        if high <= low or signal.physical[0] == signal.physical[1]:
            report.flagged.append(f"signal {i + 1}: its bounds give no scale; excluded")
            continue
        named = channel_name(signal.label)
        rate = signal.samples / head.record_s
        timing = _timing(onsets, signal.samples, rate) if head.plus else even(count * signal.samples, rate)
        shown = named.text or signal.label or f"channel {i + 1}"
        read = _reader(records, head, i, signal)
        content.channels.append(Channel(named, shown, clean_unit(signal.unit), timing, read, signal.samples))
    return content


def _take_annotations(content: Content, records: Records, head: Head, report: FileReport) -> Floats:
    """Add the marks, and return the onset of every record, s; a record without one follows the record before it."""
    places = [i for i, s in enumerate(head.signals) if s.annotations]
    onsets = np.full(records.shape[0], np.nan)
    for number in range(records.shape[0]):
        for i in places:
            begin = head.offset(i)
            found = read_annotations(records[number, begin : begin + head.width * head.signals[i].samples].tobytes())
            if i == places[0] and found and found[0].texts[:1] == ("",):
                onsets[number] = found[0].onset_s
            content.marks += [mark for a in found for mark in _marks(a)]
    if np.isnan(onsets[0]):
        onsets[0] = 0.0
    if lost := int(np.isnan(onsets).sum()):
        report.flagged.append(f"{lost} records have no time: each was put after the record before it")
        for number in np.flatnonzero(np.isnan(onsets)).tolist():
            onsets[number] = onsets[number - 1] + head.record_s
    return onsets


def _marks(annotation: Annotation) -> list[Mark]:
    return [Mark(annotation.onset_s, text, annotation.duration_s) for text in annotation.texts if text]


def _timing(onsets: Floats, samples: int, rate: float) -> Timing:
    """Find the gap-free pieces of a signal from the onsets of its records."""
    cuts = np.flatnonzero(np.abs(np.diff(onsets) - samples / rate) > 0.25 / rate) + 1
    edges = [0, *cuts.tolist(), onsets.size]
    return of_pieces([Piece(a * samples, b * samples, float(onsets[a])) for a, b in pairwise(edges)], rate)


def _reader(records: Records, head: Head, number: int, signal: Signal) -> Callable[[], Floats]:
    """Make the function that gives the samples of a signal in its unit."""
    begin = head.offset(number)
    low, high = signal.digital
    scale = (signal.physical[1] - signal.physical[0]) / (high - low)

    def read() -> Floats:
        raw = np.ascontiguousarray(records[:, begin : begin + head.width * signal.samples])
        if head.width == 2:
            digits = raw.view("<i2").ravel().astype(np.float64)
        else:
            parts = raw.reshape(-1, 3).astype(np.int32)
            digits = ((parts[:, 0] | (parts[:, 1] << 8) | (parts[:, 2] << 16)) ^ 0x800000).astype(np.float64) - 0x800000
        digits -= low
        digits *= scale
        digits += signal.physical[0]
        return digits

    return read
