"""Header and annotations of EDF, EDF+ and BDF. Source: edfplus.info/specs (EDF 1992, EDF+ 2003), biosemi.com (BDF).

Our own reader: the redactor has to know every byte of the header. Common readers put the records of an EDF+D one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from ml.formats.recording import UndecodableFile

FIXED, PER_SIGNAL = 256, 256
WIDTHS = (16, 80, 8, 8, 8, 8, 8, 80, 8, 32)
"""Bytes of label, transducer, unit, physical and digital bounds, filters, samples per record, reserved; of each signal."""
MOST_SIGNALS = 1024
LARGEST_RECORD = 64 << 20
EDF, BDF = b"0       ", b"\xffBIOSEMI"
ANNOTATIONS = ("EDF Annotations", "BDF Annotations")
HINT = "Send the EDF file as it was recorded."


@dataclass(frozen=True, slots=True)
class Signal:
    """Head of one signal; `unit` as it is written, `samples` of each record."""

    label: str
    unit: str
    physical: tuple[float, float]
    digital: tuple[float, float]
    samples: int

    @property
    def annotations(self) -> bool:
        """True where it has annotations, and no samples."""
        return self.label.strip() in ANNOTATIONS


@dataclass(frozen=True, slots=True)
class Head:
    """Header of a file.

    Attributes:
        version: its first 8 bytes. reserved: `EDF+C`, `EDF+D` or another word. started: None where it is no date.
        records: as the header says, -1 where it does not know. record_s: length of one, s.
        width: bytes of a sample.
    """

    version: bytes
    reserved: str
    started: datetime | None
    records: int
    record_s: float
    signals: tuple[Signal, ...]

    @property
    def width(self) -> int:
        """Bytes of one sample."""
        return 3 if self.version == BDF else 2

    @property
    def plus(self) -> bool:
        """True for EDF+ and BDF+, whose records have time-keeping annotations."""
        return self.reserved[:4] in ("EDF+", "BDF+") and any(s.annotations for s in self.signals)

    @property
    def size(self) -> int:
        """Bytes of the header."""
        return FIXED + PER_SIGNAL * len(self.signals)

    @property
    def record_bytes(self) -> int:
        """Bytes of one record."""
        return self.width * sum(s.samples for s in self.signals)

    def offset(self, number: int) -> int:
        """Find the first byte of a signal within a record."""
        return self.width * sum(s.samples for s in self.signals[:number])


def begins_like_edf(head: bytes) -> bool:
    """Decide by a file's first bytes whether it is EDF or BDF: its header states its own length."""
    if head[:8] not in (EDF, BDF) or len(head) < FIXED:
        return False
    size, count = head[184:192].strip(), head[252:256].strip()
    return size.isdigit() and count.isdigit() and int(size) == FIXED + PER_SIGNAL * int(count)


def read_head(raw: bytes) -> Head:
    """Read the header from a file's first bytes. Raises UndecodableFile where it contradicts itself."""
    if not begins_like_edf(raw):
        raise UndecodableFile("the header is none of an EDF or BDF file", "first 256 bytes", HINT)
    count = int(raw[252:256])
    if not 0 < count <= MOST_SIGNALS or len(raw) < FIXED + PER_SIGNAL * count:
        raise UndecodableFile("the header is cut, or has no signal", "header", HINT)
    columns: list[list[str]] = []
    at = FIXED
    for width in WIDTHS:
        columns.append([raw[at + i * width : at + (i + 1) * width].decode("latin-1").strip("\0 ") for i in range(count)])
        at += width * count
    signals = []
    for i in range(count):
        numbers = [_number(columns[c][i], f"signal {i + 1}") for c in (3, 4, 5, 6, 8)]
        signals.append(Signal(columns[0][i], columns[2][i], (numbers[0], numbers[1]), (numbers[2], numbers[3]), int(numbers[4])))
    records, record_s = int(_number(raw[236:244].decode("latin-1"), "records")), _number(raw[244:252].decode("latin-1"), "record length")
    head = Head(raw[:8], raw[192:236].decode("latin-1").strip("\0 "), _date(raw[168:184]), records, record_s, tuple(signals))
    if any(s.samples < 0 for s in signals) or not 0 < head.record_bytes <= LARGEST_RECORD or not 0 <= record_s < 1e5:
        raise UndecodableFile("the header states records of an impossible size", "header", HINT)
    return head


def _number(text: str, where: str) -> float:
    try:
        value = float(text.strip("\0 ").replace(",", "."))
        if abs(value) < 1e12:
            return value
    except ValueError:
        pass
    raise UndecodableFile("the header has a text in the place of a number", where, HINT)


def _date(raw: bytes) -> datetime | None:
    """Read `dd.mm.yyhh.mm.ss`; years 85 to 99 are of the last century."""
    text = raw.decode("latin-1")
    parts = [p for half in (text[:8], text[8:]) for p in half.replace(":", ".").replace("-", ".").replace("/", ".").split(".")]
    try:
        day, month, year, hour, minute, second = map(int, parts)
        return datetime(year + (1900 if year >= 85 else 2000), month, day, hour, minute, second)
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class Annotation:
    """One list of annotations: onset in s after the start, its duration, its texts; a time-keeping one has only an empty text."""

    onset_s: float
    duration_s: float | None
    texts: tuple[str, ...]


def read_annotations(block: bytes) -> list[Annotation]:
    """Read the annotations of one record; what is none is stepped over."""
    out = []
    for part in block.split(b"\x00"):
        head, *texts = part.split(b"\x14")
        if not texts or head[:1] not in (b"+", b"-"):
            continue
        onset, _, duration = head.partition(b"\x15")
        try:
            length = float(duration) if duration else None
            out.append(Annotation(float(onset), length, tuple(t.decode("utf-8", "replace") for t in texts[:-1])))
        except ValueError:
            continue
    return out


def write_annotations(annotations: Sequence[Annotation]) -> bytes:
    """Write the annotations of one record."""
    out = b""
    for one in annotations:
        length = f"\x15{one.duration_s:.10g}" if one.duration_s is not None else ""
        out += f"{one.onset_s:+.10g}{length}\x14{''.join(f'{t}{chr(20)}' for t in one.texts)}".encode() + b"\x00"
    return out
