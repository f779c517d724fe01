"""Decoders of uploaded files: bytes in, recordings and reports out. No database and no network in here.

`sniff`, `redact` and `decode` are the only entrances.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Literal

from ml.formats.archive import ZipFiles
from ml.formats.identity import redact
from ml.formats.options import ArchiveLimits, DecodeOptions
from ml.formats.percept import decode_percept, looks_like_report, report_members
from ml.formats.rcs import decode_rcs, find_sessions
from ml.formats.recording import (
    DECODE_VERSION,
    TREMOR_CLASSES,
    DecodedFile,
    EventLog,
    FileReport,
    GraspLog,
    Problem,
    RecordingLog,
    SpectrumLog,
    TraceLog,
    TremorLog,
    UndecodableFile,
)
from ml.formats.redaction_record import REDACTOR_VERSION, Redaction
from ml.formats.source import Source
from ml.formats.tables import TableKind, decode_table, kind_of_text
from ml.formats.tables.delimited import utf16_without_mark

__all__ = [
    "DECODE_VERSION",
    "REDACTOR_VERSION",
    "TREMOR_CLASSES",
    "ArchiveLimits",
    "DecodeOptions",
    "DecodedFile",
    "EventLog",
    "FileKind",
    "FileReport",
    "GraspLog",
    "Problem",
    "RecordingLog",
    "Redaction",
    "SpectrumLog",
    "TraceLog",
    "TremorLog",
    "UndecodableFile",
    "decode",
    "redact",
    "sniff",
]

FileKind = Literal["rcs", "percept"] | TableKind
HEAD = 65_536
HINT = (
    "Upload an RC+S session folder as a zip, a Percept session report (JSON), a table as CSV or Parquet, "
    "a tremor export, or a table of open-fist times."
)


_OTHER_ARCHIVES = (
    ("gzip", 0, b"\x1f\x8b"),
    ("bzip2", 0, b"BZh"),
    ("xz", 0, b"\xfd7zXZ\0"),
    ("7-Zip", 0, b"7z\xbc\xaf\x27\x1c"),
    ("RAR", 0, b"Rar!\x1a\x07"),
    ("tar", 257, b"ustar"),
)
"""Archives that are not unpacked: name, place and bytes of their mark. Sources: RFC 1952, POSIX, and the formats' specifications."""


def sniff(path: Source) -> FileKind:
    """Detect the kind of a file by its content, whatever its name and extension.

    Raises:
        UndecodableFile: empty, or nothing this service reads.
    """
    if isinstance(path, Path) and path.is_dir():
        return "rcs"
    with path.open("rb") as stream:
        head = stream.read(HEAD)
        zipped = head.startswith((b"PK\x03\x04", b"PK\x05\x06")) or zipfile.is_zipfile(stream)
    if not head:
        raise UndecodableFile("the file is empty", "file", HINT)
    for archive, place, mark in _OTHER_ARCHIVES:
        if head.startswith(mark, place):
            hint = "Unpack it, zip the session's folder and upload that. A single report or table needs no archive."
            raise UndecodableFile(f"this is a {archive} archive, and only zip archives are unpacked", "first bytes", hint)
    if head.startswith(b"PAR1"):
        return "parquet"
    if zipped:
        return _kind_of_zip(path)
    if looks_like_report(head):
        return "percept"
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text and len(head) < HEAD and text.strip(b"\0 \t\r\n,[]{}") == b"":
        raise UndecodableFile("the file is empty: it holds nothing but brackets or zero bytes", "file", HINT)
    if text.startswith((b"[", b"{")):
        what = "a single JSON file, neither a whole RC+S session nor a Percept session report"
        raise UndecodableFile(what, "file", "Zip the whole session folder and upload that.")
    if head.startswith((b"\xff\xfe", b"\xfe\xff")) or b"\0" not in head[:4096] or utf16_without_mark(head[:4096]) is not None:
        return kind_of_text(path)
    raise UndecodableFile("no format this service reads", "first bytes", HINT)


def _kind_of_zip(path: Source) -> FileKind:
    """Detect a zip of Percept reports, which has no RC+S file. What cannot be opened is left to the decoder of RC+S, which reports why."""
    try:
        with ZipFiles(path, ArchiveLimits()) as files:
            if not find_sessions(files, FileReport("archive")) and report_members(files):
                return "percept"
    except UndecodableFile:
        return "rcs"
    return "rcs"


def decode(path: Path, kind: FileKind | None = None, options: DecodeOptions | None = None, name: str | None = None) -> DecodedFile:
    """Decode a file.

    Args:
        path: where its bytes are; for RC+S a folder will do too.
        kind: what it is; sniffed when not given.
        options: choices that change the numbers.
        name: what to call it in reports and errors; the path's last part when not given.

    Raises:
        UndecodableFile: nothing in it can be used; says what, where and what to do.
    """
    options = options or DecodeOptions()
    kind = kind or sniff(path)
    if kind == "rcs":
        decoded = decode_rcs(path, options, name)
        if all(_is_empty(r) for r in decoded.recordings):
            said = "this upload holds no data: no stream has a sample and no stimulation log an amplitude; kept as a recording without data"
            decoded.reports[0].flagged.insert(0, said)
        return decoded
    if kind == "percept":
        return decode_percept(path, options, name)
    return decode_table(path, kind, options, name)


def _is_empty(recording: RecordingLog) -> bool:
    """Decide whether an RC+S recording has neither a sample nor an amplitude in its stimulation log."""
    logged = (e.data for e in recording.events if e.kind == "stimulation" and e.data["origin"] == "StimLog")
    stimulated = any(program["amplitude_ma"] is not None for data in logged for program in data["programs"])
    return recording.duration_s == 0 and not recording.traces and not stimulated
