"""Take identity out of an XDF file before it is stored: heads of streams are written again from what may stay, markers are reduced."""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree  # writes alone
from xml.sax.saxutils import escape  # escapes alone

import numpy as np

from ml.formats.labs.marks import clean_text
from ml.formats.labs.names import clean_label, clean_unit
from ml.formats.options import ArchiveLimits
from ml.formats.recording import UndecodableFile
from ml.formats.redaction_record import Redaction
from ml.formats.source import Source
from ml.formats.xdf.chunks import (
    BOUNDARY,
    CLOCK_OFFSET,
    FILE_HEADER,
    FORMATS,
    MAGIC,
    MOST_CHANNELS,
    MOST_STREAMS,
    SAMPLES,
    SIGNATURE,
    STREAM_FOOTER,
    STREAM_HEADER,
    Chunk,
    Damage,
    chunks,
    pack_chunk,
    read_length,
    text_of,
    tree_of,
)

HINT = "Send the XDF file as the recorder wrote it."
DATE = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}:\d{2}(\.\d{1,9})?\s?(Z|[+-]\d{2}:?\d{2})?")
TYPES = (
    "EEG", "LFP", "ECoG", "iEEG", "SEEG", "EMG", "ECG", "EOG", "EXG", "Markers", "Marker", "Events", "Stim", "Stimulation", "DBS",
    "Accelerometer", "Accel", "ACC", "Gyroscope", "Gyro", "IMU", "Mocap", "Audio", "Gaze", "Control", "VideoRaw", "Misc", "Other", 
    "Signal", "Data",
)  # fmt: skip
_LOWER = {t.lower(): t for t in TYPES}
_FOOTER = ("first_timestamp", "last_timestamp", "sample_count")
LOST = "note stim"
"""Mark in the place of lost chunks: the amplitude is unknown after it."""
_FLOATS = {"float32": "<f", "double64": "<d"}


@dataclass(frozen=True, slots=True)
class _Stream:
    channels: int
    form: str


def redact_xdf(source: Source, target: Path, key: bytes, limits: ArchiveLimits | None = None) -> Redaction:
    """Write the file without identity; the same bytes in give the same bytes out.

    Raises:
        UndecodableFile: no stream in it can be read; nothing is written then.
    """
    done, damage = Redaction(), Damage()
    counts: Counter[str] = Counter()
    streams: dict[int, _Stream] = {}
    with source.open("rb") as stream, target.open("wb") as sink:
        sink.write(MAGIC)
        for chunk in chunks(stream, damage):
            if chunk.damaged:
                _mark_loss(sink, streams)
            try:
                _write(sink, chunk, streams, counts, key)
            except ValueError:
                damage.skipped += 1
                _mark_loss(sink, streams)
    if not streams:
        target.unlink()
        raise UndecodableFile("no stream in this XDF file can be read", "file", HINT)
    if damage.skipped:
        done.flagged.append(
            f"{damage.skipped} damaged chunks were stepped over; the amplitude is unknown from the marker before each to the next"
        )
    if damage.cut_at is not None:
        done.flagged.append(
            f"the file ends within a chunk, at byte {damage.cut_at}: all before it is kept. If the original is longer, send that."
        )
    said = {
        "head": "of streams' heads: names of hosts, users, machines and sources, addresses and descriptions",
        "name": "names of streams and channels with words that are not on the lists",
        "mark": "words of markers: amplitude, rate, pulse width, side, on and off, and numbers stay",
    }
    done.removed = [f"{text} ({counts[name]}×)" for name, text in said.items() if counts[name]]
    return done


def _write(sink: BinaryIO, chunk: Chunk, streams: dict[int, _Stream], counts: Counter[str], key: bytes) -> None:
    """Write one chunk, cleaned. Raises ValueError where it contradicts itself or its stream."""
    if chunk.tag == FILE_HEADER:
        date = text_of(tree_of(chunk.content), "datetime")
        kept = f"<datetime>{date}</datetime>" if DATE.fullmatch(date) else ""
        sink.write(pack_chunk(FILE_HEADER, f'<?xml version="1.0"?><info><version>1.0</version>{kept}</info>'.encode()))
    elif chunk.tag == BOUNDARY:
        sink.write(pack_chunk(BOUNDARY, SIGNATURE))
    elif chunk.tag == STREAM_HEADER:
        if chunk.stream in streams or len(streams) >= MOST_STREAMS:
            raise ValueError("a second head")
        text, streams[chunk.stream] = _head(tree_of(chunk.content), len(streams) + 1, counts)
        sink.write(pack_chunk(STREAM_HEADER, text.encode(), chunk.stream))
    elif chunk.stream not in streams:
        raise ValueError("a stream without a head")
    elif chunk.tag == SAMPLES:
        sink.write(pack_chunk(SAMPLES, _samples(chunk.content, streams[chunk.stream], counts, key), chunk.stream))
    elif chunk.tag == CLOCK_OFFSET:
        if len(chunk.content) != 16 or not all(map(math.isfinite, struct.unpack("<dd", chunk.content))):
            raise ValueError("no clock offset")
        sink.write(pack_chunk(CLOCK_OFFSET, chunk.content, chunk.stream))
    elif chunk.tag == STREAM_FOOTER:
        tree = tree_of(chunk.content)
        kept = "".join(f"<{name}>{float(value):.17g}</{name}>" for name in _FOOTER if (value := text_of(tree, name)))
        sink.write(pack_chunk(STREAM_FOOTER, f'<?xml version="1.0"?><info>{kept}</info>'.encode(), chunk.stream))


def _head(tree: ElementTree.Element, number: int, counts: Counter[str]) -> tuple[str, _Stream]:
    """Write a stream's head from what may stay."""
    form = text_of(tree, "channel_format")
    count, rate = int(text_of(tree, "channel_count")), float(text_of(tree, "nominal_srate") or 0)
    if (form not in FORMATS and form != "string") or not 0 < count <= MOST_CHANNELS or not 0 <= rate <= 1e6:
        raise ValueError("no head of a stream")
    kind = _LOWER.get(text_of(tree, "type").lower(), "")
    name, own = clean_label(text_of(tree, "name"), kind, number)
    counts["name"] += not own
    name = name if own else f"stream {number}"
    kept = {"name", "type", "channel_count", "nominal_srate", "channel_format", "label", "unit", "channel", "channels", "desc", "info"}
    counts["head"] += sum(bool(e.text and e.text.strip()) for e in tree.iter() if e.tag not in kept)
    parts = []
    for place, channel in enumerate(tree.findall("desc/channels/channel")[:count], start=1):
        label, own = clean_label(text_of(channel, "label"), kind, place)
        counts["name"] += not own and bool(text_of(channel, "label"))
        unit = clean_unit(text_of(channel, "unit"))
        of_type = _LOWER.get(text_of(channel, "type").lower(), "")
        parts.append(f"<channel><label>{escape(label)}</label><unit>{unit}</unit><type>{of_type}</type></channel>")
    described = f"<desc><channels>{''.join(parts)}</channels></desc>"
    said = f"<name>{escape(name)}</name><type>{kind}</type><channel_count>{count}</channel_count><nominal_srate>{rate:.17g}</nominal_srate>"
    return f'<?xml version="1.0"?><info>{said}<channel_format>{form}</channel_format>{described}</info>', _Stream(count, form)


def _samples(content: bytes, stream: _Stream, counts: Counter[str], key: bytes) -> bytes:
    """Check the samples of a chunk, and clean those that are text. Raises ValueError where they are not whole."""
    count, at = read_length(content, 0)
    if stream.form != "string":
        _check(content, at, count, stream.channels * FORMATS[stream.form][1])
        return content
    out = [struct.pack("<BI", 4, count)]
    for _ in range(count):
        size = 9 if content[at : at + 1] != b"\0" else 1
        if at + size > len(content):
            raise ValueError("cut")
        out.append(content[at : at + size])
        at += size
        for _ in range(stream.channels):
            length, at = read_length(content, at)
            if at + length > len(content):
                raise ValueError("cut")
            text = content[at : at + length].decode("utf-8", "replace")
            at += length
            kept = clean_text(text, key)
            counts["mark"] += kept != text
            out.append(struct.pack("<BI", 4, len(kept.encode())) + kept.encode())
    return b"".join(out)


def _check(content: bytes, place: int, count: int, size: int) -> None:
    """Raise ValueError where a chunk does not have the samples that it claims."""
    rest = len(content) - place
    if rest == count * (9 + size):
        whole = bool(np.all(np.frombuffer(content, np.uint8, offset=place)[:: 9 + size] == 8))
    elif count and rest == count * (1 + size) + 8 and content[place] == 8:
        whole = not np.any(np.frombuffer(content, np.uint8, offset=place + 9 + size)[:: 1 + size])
    else:
        whole = False
    if whole:
        return
    for _ in range(count):
        if place >= len(content) or content[place] not in (0, 8):
            raise ValueError("no sample")
        place += (9 if content[place] else 1) + size
    if place != len(content):
        raise ValueError("another number of samples")


def _mark_loss(sink: BinaryIO, streams: dict[int, _Stream]) -> None:
    """Write a mark in the place of lost chunks into every stream that can state a dose: a text, or no number."""
    for number, stream in streams.items():
        if stream.form == "string":
            text = struct.pack("<BI", 4, len(LOST)) + LOST.encode()
            sink.write(pack_chunk(SAMPLES, b"\x01\x01\x00" + text * stream.channels, number))
        elif stream.form in _FLOATS and stream.channels == 1:
            sink.write(pack_chunk(SAMPLES, b"\x01\x01\x00" + struct.pack(_FLOATS[stream.form], math.nan), number))
