"""Uploaded files are read in children with limits of memory and time (`compute`), one child per file; this is their caller's side."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TypeVar, cast

import structlog

from app.ingest import wording
from app.platform import files
from app.platform.jobs.children.child import Cause, ChildLimits
from app.platform.jobs.children.limited import ChildEnded, run_limited
from app.platform.raw_bytes import RawFile, raw_file
from app.settings import get_settings
from ml.formats import DecodedFile, DecodeOptions, Redaction, UndecodableFile, transfer
from ml.formats.tables.mapping import TableMapping

log = structlog.get_logger()

CLEAN, PARTS, DECODE = (f"app.ingest.uploads.compute:{name}" for name in ("clean", "parts", "decode"))
"""What the children run."""

HEAD = 65_536
_Read = TypeVar("_Read")
Told = Callable[[float | None, str | None], None]
"""Takes progress: a share, 0 to 1, and a few words; None where it did not change."""


class ReaderEnded(UndecodableFile):
    """A file met a limit of the child that read it, or ended it; `cause` says which."""

    def __init__(self, cause: Cause, limits: ChildLimits) -> None:
        super().__init__(wording.reader_ended(cause, limits.memory_mb, limits.cpu_s), "file", wording.AFTER_READER_ENDED)
        self.cause = cause


class ReaderFault(Exception):
    """A fault of ours in a decoder; `places` are the lines of code that it passed, without values, which may be of a person."""

    def __init__(self, places: str) -> None:
        super().__init__("a decoder failed")
        self.places = places


@dataclass(frozen=True)
class Cleaned:
    """Result of cleaning a file: its kind and what was done to it, or why it cannot be cleaned, and the ignored parts.

    Attributes:
        mapping: place of the column mapping that read it.
        preview: of a table that cannot be read, what may be shown of it.
    """

    kind: str
    redaction: Redaction = field(default_factory=Redaction)
    problem: UndecodableFile | None = None
    mapping: int | None = None
    preview: dict[str, Any] | None = None


def clean(
    source: RawFile,
    target: Path,
    options: DecodeOptions,
    who: str = "",
    told: Told = lambda *_: None,
    mappings: Sequence[TableMapping] = (),
) -> Cleaned:
    """Write a file without identity to `target`.

    Args:
        source: the raw bytes.
        target: where the bytes without identity go; of no use where the file cannot be cleaned.
        options: choices of the decoder, which checks tables as the sender wrote them.
        who: whose files take turns where many are to be read.
        `told`: takes progress.
        mappings: the study's column mappings; a table with the header of one is read by it.

    Raises:
        ReaderEnded: the child met a limit or was ended. ReaderFault: our decoder failed.
    """
    params = {
        "source": _paths_of(source),
        "target": os.path.abspath(target),
        "secrets": str(get_settings().data_dir.resolve() / "secrets"),
        "options": asdict(options),
        "mappings": [m.to_json() for m in mappings],
    }
    get_settings().secret("pseudonyms")  # made here, where it is missing: children only read it
    with raw_file() as (_, room):
        found = _run(CLEAN, {**params, "room": _paths_of(room)}, who, told)
    if "problem" in found:
        problem = UndecodableFile(*found["problem"])
        return Cleaned("unreadable", Redaction(ignored=found["left_out"]), problem, preview=found["preview"])
    return Cleaned(found["kind"], Redaction(**found["redaction"]), mapping=found["mapping"])


@dataclass(frozen=True)
class FileParts:
    """Parts of a file that holds several: name and bytes of each, and sentences on what is no part."""

    parts: list[tuple[str, BinaryIO]]
    ignored: list[str]


def may_have_parts(head: bytes) -> bool:
    """Decide by the first `HEAD` bytes of a file whether `parts` may find any."""
    if head.startswith((b"PK\x03\x04", b"PAR1")):
        return True
    words = head.replace(b"\0", b"").lower()
    return not words.lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n").startswith((b"{", b"[")) and (b"session" in words or b"run" in words)


def parts(source: RawFile, options: DecodeOptions, who: str = "", watch: Told = lambda *_: None) -> FileParts | None:
    """Take a file apart: a zip of tables, or a table with a column of sessions; None where it is one of its own.

    Args:
        source: the raw bytes. options: bounds of archives. who: as of `clean`. watch: takes progress.

    Raises:
        UndecodableFile: its sessions cannot be separated.
    """
    with source.open() as stream:
        if not may_have_parts(stream.read(HEAD)):
            return None
    with raw_file() as (_, room):
        params = {"source": _paths_of(source), "room": _paths_of(room), "archive": asdict(options.archive)}
        try:
            found = _run(PARTS, params, who, watch)
        except (ReaderEnded, ReaderFault) as fault:
            log.error("file not taken apart", fault=type(fault).__name__)
            return None  # it is read as a whole, where the same fault is reported with the file
        if "problem" in found:
            raise UndecodableFile(*found["problem"])
        if not found["names"]:
            return None
        archive = zipfile.ZipFile(room.open())  # outlives the room, until its last part is read
        return FileParts([(name, cast(BinaryIO, archive.open(name))) for name in found["names"]], found["ignored"])


def _paths_of(raw: RawFile) -> list[str]:
    return [os.path.abspath(raw.encrypted), os.path.abspath(raw.key)]


def decode(source: Path, kind: str, options: DecodeOptions, name: str, who: str = "", told: Told = lambda *_: None) -> DecodedFile:
    """Decode a file without identity; arguments as of `clean`, `name` as reports should show it.

    Raises:
        UndecodableFile: nothing in it can be used. ReaderEnded, a kind of it, and ReaderFault as `clean`.
    """
    with files.draft_folder() as folder:
        params = {"source": os.path.abspath(source), "kind": kind, "name": name, "options": asdict(options), "target": str(folder)}
        found = _run(DECODE, params, who, told)
        if "problem" in found:
            raise UndecodableFile(*found["problem"])
        return transfer.read(folder)


def _run(reference: str, params: Mapping[str, Any], who: str, told: Told) -> dict[str, Any]:
    settings = get_settings()
    limits = ChildLimits(settings.decode_memory_mb, settings.decode_seconds, quotes=False)
    try:
        return run_limited(reference, dict(params), limits, told, who)
    except ChildEnded as ended:
        if ended.cause == "error":
            raise ReaderFault(ended.log) from None
        raise ReaderEnded(ended.cause, limits) from None


def twice(read: Callable[[], _Read], again: Callable[[], bool] = lambda: True) -> _Read:
    """Decode in a child process. If the child ends, retry once (see `again`), since memory may have been short.

    Raises:
        ReaderEnded: it ended that child too.
    """
    try:
        return read()
    except ReaderEnded as ended:
        log.warning("reading a file ended the reader", cause=ended.cause)
        if not again():
            raise
        return read()
