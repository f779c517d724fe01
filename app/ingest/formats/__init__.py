"""Decoders of uploaded files: bytes in, recordings and reports out. No database and no network in here."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Literal

from app.ingest.formats.log import (
    DECODE_VERSION,
    DecodedFile,
    EventLog,
    FileReport,
    Problem,
    RecordingLog,
    SessionLog,
    TraceLog,
    UndecodableFile,
)
from app.ingest.formats.options import ArchiveLimits, DecodeOptions
from app.ingest.formats.rcs import decode_rcs
from app.ingest.formats.table import decode_csv, decode_parquet

__all__ = [
    "DECODE_VERSION",
    "ArchiveLimits",
    "DecodeOptions",
    "DecodedFile",
    "EventLog",
    "FileKind",
    "FileReport",
    "Problem",
    "RecordingLog",
    "SessionLog",
    "TraceLog",
    "UndecodableFile",
    "decode",
    "sniff",
]

FileKind = Literal["rcs", "csv", "parquet"]
MEND = "Upload an RC+S session folder as a zip, or a table as CSV or Parquet."


def sniff(path: Path) -> FileKind:
    """What a file is, by its content; its name and extension are not asked.

    Raises:
        UndecodableFile: empty, or nothing this service reads.
    """
    if path.is_dir():
        return "rcs"
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not head:
        raise UndecodableFile("the file is empty", "file", MEND)
    if head.startswith(b"PAR1"):
        return "parquet"
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")) or zipfile.is_zipfile(path):
        return "rcs"
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text.startswith((b"[", b"{")):
        raise UndecodableFile("a single JSON file, not a session", "file", "Zip the whole session folder and upload that.")
    if head.startswith((b"\xff\xfe", b"\xfe\xff")) or b"\0" not in head:
        return "csv"
    raise UndecodableFile("no format this service reads", "first bytes", MEND)


def decode(path: Path, kind: FileKind | None = None, options: DecodeOptions | None = None, name: str | None = None) -> DecodedFile:
    """Decode a file.

    Args:
        path: where its bytes are; for RC+S a folder will do too.
        kind: what it is; sniffed when not given.
        options: choices that change the numbers.
        name: what to call it in reports and errors; the path's last part when not given.

    Raises:
        UndecodableFile: nothing in it can be used; says what, where and how to mend it.
    """
    options = options or DecodeOptions()
    kind = kind or sniff(path)
    if kind == "rcs":
        decoded = decode_rcs(path, options, name)
        if all(_is_empty(r) for r in decoded.recordings):
            said = "this upload holds no data: no stream has a sample and no stimulation log an amplitude; kept as a recording without data"
            decoded.reports[0].flagged.insert(0, said)
        return decoded
    return decode_parquet(path, options, name) if kind == "parquet" else decode_csv(path, options, name)


def _is_empty(recording: RecordingLog) -> bool:
    """Whether an RC+S recording has neither a sample nor an amplitude in its stimulation log."""
    logged = (e.data for e in recording.events if e.kind == "stimulation" and e.data["origin"] == "StimLog")
    stimulated = any(program["amplitude_ma"] is not None for data in logged for program in data["programs"])
    return recording.duration_s == 0 and not recording.traces and not stimulated
