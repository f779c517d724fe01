"""Header, markers and samples of a BrainVision recording, found by their content. Source: BrainVision Core Data Format 1.0."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

from ml.formats.archive import READ_ERRORS, Files
from ml.formats.loose import LooseFiles, Opening
from ml.formats.recording import FileReport, UndecodableFile

HEADER, MARKERS = "Data Exchange Header File", "Data Exchange Marker File"
LARGEST_TEXT = 16 << 20
MOST_CHANNELS = 1024
HINT = "Send the three files of the recording together: .vhdr, .vmrk and .eeg, as one zip or in one upload."
_SECTION = re.compile(r"\s*\[(.+)\]\s*")
WIDTHS = {"INT_16": ("<i2", 2), "UINT_16": ("<u2", 2), "INT_32": ("<i4", 4), "IEEE_FLOAT_32": ("<f4", 4)}
"""Type and bytes of a sample by the header's word."""


@dataclass(frozen=True, slots=True)
class Parts:
    """Members of one recording: names within the archive; `markers` is None where the header names none."""

    header: str
    samples: str
    markers: str | None


@dataclass(frozen=True, slots=True)
class Head:
    """Header: rate in Hz, format of samples, whether channels alternate, and (name, units per bit, unit) of each channel."""

    rate_hz: float
    binary: str
    alternate: bool
    channels: tuple[tuple[str, float, str], ...]


@dataclass(frozen=True, slots=True)
class Marker:
    """Marker: its type and description, the sample at which it is, from 0, its length in samples, and the date of a segment."""

    kind: str
    text: str
    sample: int
    length: int
    date: str


def _opening(name: str, head: bytes) -> Opening:
    path = PurePosixPath(name)
    text = head[:200].decode("latin-1")
    stem = "header" if HEADER in text else "markers" if MARKERS in text else "samples" if path.suffix.lower() == ".eeg" else None
    return Opening(stem, session=path.stem.lower()) if stem else Opening()


LOOSE = LooseFiles("BrainVision", 256, _opening)


def first_line(files: Files, name: str) -> str:
    """Read the begin of a member; empty where it cannot be read."""
    try:
        with files.open(name) as stream:
            return stream.read(200).decode("latin-1")
    except (UndecodableFile, *READ_ERRORS):
        return ""


def holds_recording(files: Files, report: FileReport) -> bool:
    """Decide whether an archive has the header of a recording."""
    return any(HEADER in first_line(files, name) for name in files.names())


def find_parts(files: Files) -> list[Parts]:
    """Find the recordings of an archive.

    Raises:
        UndecodableFile: a header whose samples or markers are not there. Without markers the gaps of a recording cannot be seen.
    """
    names = files.names()
    heads = [n for n in names if HEADER in first_line(files, n)]
    marks = [n for n in names if MARKERS in first_line(files, n)]
    others = [n for n in names if n not in heads and n not in marks]
    out = []
    for number, name in enumerate(heads, start=1):
        common = sections(read_text(files, name)).get("common infos", {})
        samples = _member(name, common.get("datafile", ""), others, len(heads))
        markers = _member(name, common.get("markerfile", ""), marks, len(heads))
        if samples is None:
            raise UndecodableFile("the file of samples that the header names is not there", f"header {number}, DataFile", HINT)
        if markers is None and common.get("markerfile"):
            what = "the marker file that the header names is not there, and without it no gap can be seen"
            raise UndecodableFile(what, f"header {number}, MarkerFile", HINT)
        out.append(Parts(name, samples, markers))
    return out


def _member(header: str, data_file: str, candidates: list[str], heads: int) -> str | None:
    """Find the member that a header names; the only one of its kind where files were renamed on the way."""
    folder, stem = PurePosixPath(header).parent, PurePosixPath(header).stem.lower()
    named = PurePosixPath(data_file.replace("\\", "/")).name.replace("$b", PurePosixPath(header).stem).lower()
    near = [c for c in candidates if PurePosixPath(c).parent == folder]
    exact = [c for c in near if named and PurePosixPath(c).name.lower() == named] or [
        c for c in near if PurePosixPath(c).stem.lower() == stem
    ]
    if exact:
        return exact[0]
    return candidates[0] if heads == 1 and len(candidates) == 1 and data_file else None


def read_text(files: Files, name: str) -> str:
    """Read a header or marker file as text."""
    with files.open(name) as stream:
        raw = stream.read(LARGEST_TEXT)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def sections(text: str) -> dict[str, dict[str, str]]:
    """Read sections of keys and values; keys in lower case. The comment at the end is not read."""
    out: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for line in text.splitlines():
        if (match := _SECTION.fullmatch(line)) is not None:
            current = {} if match[1].strip().lower() == "comment" else out.setdefault(match[1].strip().lower(), {})
        elif "=" in line and not line.lstrip().startswith(";"):
            key, _, value = line.partition("=")
            current[key.strip().lower()] = value.strip()
    return out


def read_head(text: str) -> Head:
    """Read the header. Raises UndecodableFile where it lacks a number, or has a format that is not read."""
    found = sections(text)
    common, binary = found.get("common infos", {}), found.get("binary infos", {}).get("binaryformat", "")
    if common.get("dataformat", "BINARY").upper() != "BINARY" or binary.upper() not in WIDTHS:
        raise UndecodableFile(
            "samples as text, or of an unknown format, are not read", "header, BinaryFormat", "Export it as INT_16 or float."
        )
    if found.get("binary infos", {}).get("usebigendianorder", "NO").upper() == "YES":
        raise UndecodableFile("samples with the highest byte first are not read", "header, UseBigEndianOrder", "Export it again.")
    try:
        count, interval_us = int(common["numberofchannels"]), float(common["samplinginterval"])
        if not 0 < count <= MOST_CHANNELS or not 1 <= interval_us <= 1e6:
            raise ValueError("out of range")
        rows = [[p.replace("\\1", ",") for p in found["channel infos"][f"ch{i + 1}"].split(",")] + [""] * 4 for i in range(count)]
        channels = tuple((row[0], float(row[2] or 1), row[3] or "µV") for row in rows)
    except (KeyError, ValueError) as error:
        raise UndecodableFile("the header lacks channels, their resolution or the sampling interval", "header", HINT) from error
    return Head(1e6 / interval_us, binary.upper(), common.get("dataorientation", "MULTIPLEXED").upper() == "MULTIPLEXED", channels)


def read_markers(text: str) -> list[Marker]:
    """Read the markers in their order; an entry that is none is stepped over."""
    out = []
    for key, value in sections(text).get("marker infos", {}).items():
        parts = [p.replace("\\1", ",").strip() for p in value.split(",")]
        if re.fullmatch(r"mk\d+", key) and len(parts) >= 3 and parts[2].isdigit():
            length = int(parts[3]) if len(parts) > 3 and parts[3].isdigit() else 1
            out.append(Marker(parts[0], parts[1], max(0, int(parts[2]) - 1), length, parts[5] if len(parts) > 5 else ""))
    return sorted(out, key=lambda m: m.sample)
