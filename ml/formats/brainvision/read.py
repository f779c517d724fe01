"""Reader of BrainVision recordings without identity. The dates of New Segment markers say how long a gap is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.archive import ZipFiles
from ml.formats.brainvision.files import WIDTHS, Head, Marker, find_parts, read_head, read_markers, read_text
from ml.formats.labs.build import recordings_of
from ml.formats.labs.content import Channel, Content, Floats
from ml.formats.labs.marks import Mark
from ml.formats.labs.names import channel_name, clean_unit
from ml.formats.labs.timing import Piece, of_pieces
from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, FileReport, RecordingLog

SEGMENT = "New Segment"


def decode_brainvision(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode the recordings that `redact_brainvision` wrote.

    Raises:
        UndecodableFile: a recording without a channel of a local field potential.
    """
    recordings: list[RecordingLog] = []
    reports = []
    with ZipFiles(path, options.archive) as files:
        parts = find_parts(files)
        for number, part in enumerate(parts):
            report = FileReport(name or path.name if len(parts) == 1 else f"recording {number + 1}")
            reports.append(report)
            head = read_head(read_text(files, part.header))
            markers = read_markers(read_text(files, part.markers)) if part.markers else []
            with files.open(part.samples) as stream:
                content = read_brainvision(stream.read(), head, markers, report)
            recordings += [replace(r, run=number) for r in recordings_of(content, options, report)]
    return DecodedFile(tuple(recordings), tuple(reports))


def read_brainvision(raw: bytes, head: Head, markers: list[Marker], report: FileReport) -> Content:
    """Read channels and marks; 0 is the first sample."""
    form, width = WIDTHS[head.binary]
    count = len(head.channels)
    n, rest = divmod(len(raw), width * count)
    if rest:
        report.flagged.append(f"the file of samples ends within a sample: {rest} bytes are excluded. If the original is longer, send that.")
    flat: NDArray[Any] = np.frombuffer(raw, form, n * count)
    values = flat.reshape(n, count).T if head.alternate else flat.reshape(count, n)
    content = Content("brainvision")
    pieces, times = _pieces(n, head, markers, content, report)
    timing = of_pieces(pieces, head.rate_hz)
    for marker in markers:
        if marker.kind != SEGMENT and marker.text and (t_s := times(marker.sample)) is not None:
            content.marks.append(Mark(t_s, marker.text, marker.length / head.rate_hz if marker.length > 1 else None))
    for i, (label, scale, unit) in enumerate(head.channels):
        named = channel_name(label)
        content.channels.append(Channel(named, named.text or label, clean_unit(unit), timing, _reader(values, i, scale)))
    return content


def _pieces(
    n: int, head: Head, markers: list[Marker], content: Content, report: FileReport
) -> tuple[list[Piece], Callable[[int], float | None]]:  # fmt: skip
    """Find the segments, and the time of each sample; samples after a segment whose date is unknown have none."""
    begins = {m.sample: _date(m.date) for m in markers if m.kind == SEGMENT and m.sample < n}
    first = begins.get(0)
    if first is not None:
        content.started = (0.0, first)
    else:
        report.flagged.append("the recording has no date: state the start with the upload")
    pieces: list[Piece] = []
    for begin, end in pairwise([*sorted({0, *begins}), n]):
        date = begins.get(begin)
        if begin and (date is None or first is None):
            report.flagged.append(
                f"a segment begins at sample {begin + 1} without a date, so the gap before it is unknown: the rest is excluded"
            )
            break
        start = (date - first).total_seconds() if begin and date is not None and first is not None else 0.0
        pieces.append(Piece(begin, end, start))

    def times(sample: int) -> float | None:
        piece = next((p for p in reversed(pieces) if p.begin <= sample), None)
        return None if piece is None or sample > piece.end else piece.start_s + (sample - piece.begin) / head.rate_hz

    return pieces, times


def _date(text: str) -> datetime | None:
    """Read `YYYYMMDDhhmmssuuuuuu`; zeros are no date."""
    try:
        return datetime.strptime(text[:14], "%Y%m%d%H%M%S") + timedelta(microseconds=int(text[14:20]))
    except ValueError:
        return None


def _reader(values: NDArray[Any], i: int, scale: float) -> Callable[[], Floats]:
    return lambda: values[i].astype(np.float64) * scale
