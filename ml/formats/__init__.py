"""Decoders of uploaded files: bytes in, recordings and reports out. No database and no network in here.

`sniff`, `redact` and `decode` are the entrances. `registry` has one record per format of a device.
"""

from __future__ import annotations

import zipfile
from collections import Counter
from pathlib import Path

from ml.formats.archive import ZipFiles
from ml.formats.facts.clocks import lead_in_words
from ml.formats.labs.meanings import AMPLITUDE_UNITS, CHANNEL_KEY, LEVER_KEY, Meaning, Means, Question
from ml.formats.options import ArchiveLimits, BetaMeasure, DecodeOptions
from ml.formats.recording import (
    DECODE_VERSION,
    DecodedFile,
    EventLog,
    FileReport,
    OutcomeLog,
    Problem,
    RecordingLog,
    SampleLog,
    SpectrumLog,
    TraceLog,
    TraceSource,
    UndecodableFile,
)
from ml.formats.redaction_record import REDACTOR_VERSION, Redaction, pseudonym
from ml.formats.registry import BY_KIND, DEVICE_NAMES, DEVICES, FILE_NAMES, SOURCE_NAMES, DeviceFormat
from ml.formats.source import Source
from ml.formats.tables import TABLES, decode_table, kind_of_text, redact_table
from ml.formats.tables.cells.delimited import utf16_without_mark
from ml.formats.tables.grasps import GraspLog
from ml.formats.tables.outcome_tables import OUTCOME_TABLES
from ml.formats.tables.strivepd import TremorLog

__all__ = [
    "AMPLITUDE_UNITS",
    "BY_KIND",
    "CHANNEL_KEY",
    "DECODE_VERSION",
    "DEVICES",
    "DEVICE_NAMES",
    "FILE_NAMES",
    "LEVER_KEY",
    "OUTCOME_TABLES",
    "REDACTOR_VERSION",
    "SOURCE_NAMES",
    "TABLES",
    "ArchiveLimits",
    "BetaMeasure",
    "DecodeOptions",
    "DecodedFile",
    "DeviceFormat",
    "EventLog",
    "FileKind",
    "FileReport",
    "GraspLog",
    "Meaning",
    "Means",
    "OutcomeLog",
    "Problem",
    "Question",
    "RecordingLog",
    "Redaction",
    "SampleLog",
    "Source",
    "SpectrumLog",
    "TraceLog",
    "TraceSource",
    "TremorLog",
    "UndecodableFile",
    "decode",
    "lead_in_words",
    "left_out_of",
    "pseudonym",
    "redact",
    "sniff",
]

FileKind = str
"""Kind of a file: that of a device's format, or of a table (`TABLES`)."""
HEAD = 65_536
HINT = f"Upload {', '.join(one.upload for one in DEVICES)}, a table as CSV or Parquet, a tremor export, or a table of open-fist times."

_OTHER_ARCHIVES = (
    ("gzip", 0, b"\x1f\x8b"),
    ("bzip2", 0, b"BZh"),
    ("xz", 0, b"\xfd7zXZ\0"),
    ("7-Zip", 0, b"7z\xbc\xaf\x27\x1c"),
    ("RAR", 0, b"Rar!\x1a\x07"),
    ("tar", 257, b"ustar"),
)
"""Archives that no decoder unpacks: name, place and bytes of their mark. An upload unpacks one layer of gzip and tar first.

Sources: RFC 1952, POSIX, and the formats' specifications.
"""


_ZIPPED = next(one.kind for one in DEVICES if one.zipped)


def sniff(path: Source) -> FileKind:
    """Detect the kind of a file by its content, whatever its name and extension.

    Raises:
        UndecodableFile: empty, or nothing this service reads.
    """
    if isinstance(path, Path) and path.is_dir():
        return _ZIPPED
    with path.open("rb") as stream:
        head = stream.read(HEAD)
        zipped = head.startswith((b"PK\x03\x04", b"PK\x05\x06")) or zipfile.is_zipfile(stream)
    if not head:
        raise UndecodableFile("the file is empty", "file", HINT)
    for archive, place, mark in _OTHER_ARCHIVES:
        if head.startswith(mark, place):
            hint = "Unpack it, zip the session's folder and upload that. A single report or table needs no archive."
            raise UndecodableFile(f"this is a {archive} archive, which is not unpacked here", "first bytes", hint)
    if head.startswith(b"PAR1"):
        return "parquet"
    if zipped:
        return _kind_of_zip(path)
    for one in DEVICES:
        if (not one.magic or head.startswith(one.magic)) and one.code.begins(head):
            return one.kind
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text and len(head) < HEAD and text.strip(b"\0 \t\r\n,[]{}") == b"":
        raise UndecodableFile("the file is empty: it holds nothing but brackets or zero bytes", "file", HINT)
    if text.startswith((b"[", b"{")):
        what = f"a single JSON file, and no {' and no '.join(FILE_NAMES.values())}"
        raise UndecodableFile(what, "file", "Zip the whole session folder and upload that.")
    if head.startswith((b"\xff\xfe", b"\xfe\xff")) or b"\0" not in head[:4096] or utf16_without_mark(head[:4096]) is not None:
        return kind_of_text(path)
    raise UndecodableFile("no format this service reads", "first bytes", HINT)


def _kind_of_zip(path: Source) -> FileKind:
    """Detect the kind of a zip by its files. One that cannot be opened is left to a decoder that reports why."""
    try:
        with ZipFiles(path, ArchiveLimits()) as files:
            return next((one.kind for one in DEVICES if one.code.within(files, FileReport("archive"))), _ZIPPED)
    except UndecodableFile:
        return _ZIPPED


def redact(source: Source, target: Path, kind: FileKind, key: bytes, options: DecodeOptions | None = None) -> Redaction:
    """Write a file without identity; the same bytes in give the same bytes out, and they decode to the same content.

    Args:
        source: the uploaded file.
        target: where the redacted file is written.
        kind: what it is, from `sniff`.
        key: secret of the installation for pseudonyms of devices, at least 16 bytes.
        options: choices of the decoder, which checks tables as the sender wrote them.

    Raises:
        UndecodableFile: it cannot be parsed, and so not be cleaned; nothing is written then.
        ValueError: a table that a column mapping reads; `tables.mapping.redact_mapped` cleans it.
    """
    options = options or DecodeOptions()
    if kind in BY_KIND:
        return BY_KIND[kind].code.redact(source, target, key, options.archive)
    return redact_table(source, target, kind, options)


def decode(path: Path, kind: FileKind | None = None, options: DecodeOptions | None = None, name: str | None = None) -> DecodedFile:
    """Decode a file.

    Args:
        path: where its bytes are; a folder will do too where a format has one.
        kind: what it is; sniffed when not given.
        options: choices that change the numbers.
        name: what to call it in reports and errors; the path's last part when not given.

    Raises:
        UndecodableFile: nothing in it can be used; says what, where and what to do.
    """
    options = options or DecodeOptions()
    kind = kind or sniff(path)
    if kind in BY_KIND:
        return BY_KIND[kind].code.decode(path, options, name)
    return decode_table(path, kind, options, name)


def left_out_of(source: Source, limits: ArchiveLimits) -> list[str]:
    """Count the reasons why members of an archive were ignored, without their names, which may identify a person; of no archive none."""
    with source.open("rb") as stream:
        if not zipfile.is_zipfile(stream):
            return []
    listing = FileReport("archive")
    try:
        with ZipFiles(source, limits) as members:
            BY_KIND[_ZIPPED].code.within(members, listing)
            reasons = Counter(member.reason for member in members.left_out)
    except UndecodableFile:
        return []  # the problem itself says what is wrong with the archive
    return [*listing.ignored, *(f"{n} file{'s' if n > 1 else ''}: {reason}" for reason, n in sorted(reasons.items()))]
