"""Take identity out of an EDF or BDF file before it is stored: its header is written again from what may stay, annotations are reduced."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from ml.formats.edf.head import FIXED, MOST_SIGNALS, PER_SIGNAL, Annotation, Head, read_annotations, read_head, write_annotations
from ml.formats.labs.marks import clean_text
from ml.formats.labs.names import clean_label, clean_unit
from ml.formats.options import ArchiveLimits
from ml.formats.recording import UndecodableFile
from ml.formats.redaction_record import Redaction
from ml.formats.source import Source


def redact_edf(source: Source, target: Path, key: bytes, limits: ArchiveLimits | None = None) -> Redaction:
    """Write the file without identity; the same bytes in give the same bytes out.

    Raises:
        UndecodableFile: the header contradicts itself, or there is no whole record; nothing is written then.
    """
    done = Redaction()
    with source.open("rb") as stream:
        raw = stream.read(FIXED + PER_SIGNAL * MOST_SIGNALS)
        head = read_head(raw)
        size = stream.seek(0, 2) - head.size
        records, rest = divmod(size, head.record_bytes)
        if records < 1:
            raise UndecodableFile("there is no whole data record", f"byte {head.size}", "Send the EDF file as it was recorded.")
        if head.records not in (-1, records) or rest:
            said = f"the header says {head.records} records, the file has {records}"
            done.flagged.append(f"{said}{f' and {rest} bytes of another' if rest else ''}: the {records} whole records are kept")
        place = _annotation_places(head)
        texts, removed = _annotations(stream, head, records, place, key)
        new = _new_head(raw, head, records, max((len(t) for row in texts for t in row), default=0), done)
        with target.open("wb") as sink:
            sink.write(new)
            grown = read_head(new)
            stream.seek(head.size)
            for row in texts:
                sink.write(_record(stream.read(head.record_bytes), head, grown, place, row))
    if removed:
        done.removed.append(f"words of annotations: amplitude, rate, pulse width, side, on and off, and numbers stay ({removed}×)")
    return done


def _annotation_places(head: Head) -> list[int]:
    return [i for i, s in enumerate(head.signals) if s.annotations]


def _annotations(stream: BinaryIO, head: Head, records: int, places: list[int], key: bytes) -> tuple[list[list[bytes]], int]:
    """Clean the annotations of every record; returns them per record and signal, and how many texts changed."""
    rows: list[list[bytes]] = []
    removed = 0
    for number in range(records):
        row = []
        for i in places:
            stream.seek(head.size + number * head.record_bytes + head.offset(i))
            found = read_annotations(stream.read(head.width * head.signals[i].samples))
            kept = [Annotation(a.onset_s, a.duration_s, tuple(clean_text(t, key) if t else "" for t in a.texts)) for a in found]
            removed += sum(a.texts != b.texts for a, b in zip(found, kept, strict=True))
            row.append(write_annotations(kept))
        rows.append(row)
    return rows, removed


def _new_head(raw: bytes, head: Head, records: int, longest: int, account: Redaction) -> bytes:
    """Write the header from what may stay."""
    signals, named = [], 0
    for number, signal in enumerate(head.signals, start=1):
        if signal.annotations:
            signals.append(replace(signal, samples=max(signal.samples, -(-longest // head.width))))
            continue
        label, own = clean_label(signal.label, "", number)
        named += not own
        signals.append(replace(signal, label=label, unit=clean_unit(signal.unit)))
    plus = head.reserved[:5] if head.reserved[:5] in ("EDF+C", "EDF+D", "BDF+C", "BDF+D") else "24BIT" if head.width == 3 else ""
    fixed = head.version + _text("X X X X" if head.plus else "", 80) + _text("Startdate X X X X" if head.plus else "", 80)
    fixed += raw[168:184] if head.started is not None else b"01.01.8500.00.00"
    fixed += _text(str(head.size), 8) + _text(plus, 44) + _text(str(records), 8) + raw[244:252] + _text(str(len(signals)), 4)
    count = len(signals)
    numbers = FIXED + count * (16 + 80 + 8)
    bounds = raw[numbers : numbers + count * 32]
    columns = [[_text(s.label, 16) for s in signals], [_text("", 80)] * count, [_text(s.unit, 8) for s in signals], [bounds]]
    columns += [[_text("", 80)] * count, [_text(str(s.samples), 8) for s in signals], [_text("", 32)] * count]
    account.removed.append("patient and recording fields of the header, transducers, filters and reserved fields")
    if named:
        account.removed.append(f"names of channels with words that are not on the lists ({named}×)")
    return fixed + b"".join(b"".join(column) for column in columns)


def _text(text: str, width: int) -> bytes:
    return text.encode("latin-1", "replace")[:width].ljust(width)


def _record(raw: bytes, head: Head, target: Head, places: list[int], texts: list[bytes]) -> bytes:
    """Write one record: samples as they are, annotations cleaned."""
    out, done = b"", 0
    for i, text in zip(places, texts, strict=True):
        out += raw[done : head.offset(i)] + text.ljust(target.width * target.signals[i].samples, b"\0")
        done = head.offset(i) + head.width * head.signals[i].samples
    return out + raw[done:]
