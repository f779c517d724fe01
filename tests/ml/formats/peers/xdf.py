"""XDF files written by the specification 1.0, as LabRecorder writes them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

BOUNDARY = bytes.fromhex("43a546dccbf5410fb30ed5467383cbe4")
FORMATS = {"float32": "<f4", "double64": "<f8", "int16": "<i2", "int32": "<i4"}


@dataclass
class Stream:
    """One stream.

    Attributes:
        stamps: as the file has them, on the stream's own clock, [n].
        values: numbers [n, channels], or texts [n].
        offset_s: what is added to its first stamp to have the recorder's; None: the stream has no clock offsets.
        drift: by which that grows per second of the stream's clock.
        per_chunk: samples of a chunk. stamped: whether each sample has its stamp, or only the first of a chunk.
    """

    name: str
    kind: str
    rate_hz: float
    stamps: np.ndarray
    values: np.ndarray | list[str]
    labels: Sequence[str] = ()
    units: Sequence[str] = ()
    form: str = "float32"
    offset_s: float | None = 0.0
    per_chunk: int = 32
    stamped: bool = True
    extra: str = ""
    drift: float = 0.0

    def offset(self, stamp: float) -> float:
        """Compute the difference from a stamp to the recorder's clock, s."""
        return (self.offset_s or 0.0) + self.drift * (stamp - float(self.stamps[0]))


def chunk(tag: int, content: bytes, stream: int | None = None) -> bytes:
    body = struct.pack("<H", tag) + (b"" if stream is None else struct.pack("<I", stream)) + content
    return struct.pack("<BI", 4, len(body)) + body


def head(stream: Stream, count: int) -> bytes:
    channels = "".join(
        f"<channel><label>{escape(label)}</label><unit>{(*stream.units, *[''] * 99)[i]}</unit><type>{stream.kind}</type></channel>"
        for i, label in enumerate(stream.labels)
    )
    text = (
        f'<?xml version="1.0"?><info><name>{escape(stream.name)}</name><type>{stream.kind}</type><channel_count>{count}</channel_count>'
        f"<nominal_srate>{stream.rate_hz:g}</nominal_srate><channel_format>{stream.form}</channel_format>{stream.extra}"
        f"<desc><channels>{channels}</channels></desc></info>"
    )
    return text.encode()


def samples(stream: Stream, begin: int, end: int) -> bytes:
    out = [struct.pack("<BI", 4, end - begin)]
    for i in range(begin, end):
        out.append(b"\x08" + struct.pack("<d", stream.stamps[i]) if stream.stamped or i == begin else b"\x00")
        if isinstance(stream.values, list):
            raw = stream.values[i].encode()
            out.append(struct.pack("<BI", 4, len(raw)) + raw)
        else:
            out.append(np.asarray(stream.values[i]).astype(FORMATS[stream.form]).tobytes())
    return b"".join(out)


def write(
    path: Path, streams: Sequence[Stream], date: str = "2026-03-02T09:00:00+0100", closed: bool = True, cut: int | None = None
) -> None:
    """Write streams in turns, a boundary after each round; `cut` bytes are taken off the end."""
    counts = [1 if isinstance(s.values, list) else np.asarray(s.values).shape[1] for s in streams]
    out = [b"XDF:", chunk(1, f'<?xml version="1.0"?><info><version>1.0</version><datetime>{date}</datetime></info>'.encode())]
    out += [chunk(2, head(s, c), i + 1) for i, (s, c) in enumerate(zip(streams, counts, strict=True))]
    pieces: list[tuple[float, bytes]] = []
    for i, s in enumerate(streams):
        # a loss is between two chunks: within one, stamps follow from the first
        lost = np.flatnonzero(np.diff(s.stamps) > 1.5 / s.rate_hz) + 1 if s.rate_hz and not s.stamped else np.empty(0, dtype=int)
        begins = sorted({*range(0, len(s.stamps), s.per_chunk), *lost.tolist()})
        latest = -np.inf
        for begin, end in pairwise([*begins, len(s.stamps)]):
            # jitter puts no chunk before an earlier one
            latest = max(latest, float(s.stamps[begin]) + s.offset(float(s.stamps[begin])))
            pieces.append((latest, chunk(3, samples(s, begin, end), i + 1)))
        if s.offset_s is not None and len(s.stamps):
            for at in np.arange(float(s.stamps[0]), float(s.stamps[-1]) + 5.0, 5.0):
                pieces.append((at + s.offset(at), chunk(4, struct.pack("<dd", at, s.offset(at)), i + 1)))
    for k, (_, piece) in enumerate(sorted(pieces, key=lambda p: p[0])):
        out.append(piece)
        if k % 50 == 49:
            out.append(chunk(5, BOUNDARY))
    if closed:
        for i, s in enumerate(streams):
            said = f"<first_timestamp>{s.stamps[0] if len(s.stamps) else 0}</first_timestamp><sample_count>{len(s.stamps)}</sample_count>"
            out.append(chunk(6, f"<info>{said}</info>".encode(), i + 1))
    raw = b"".join(out)
    path.write_bytes(raw if cut is None else raw[:-cut])
