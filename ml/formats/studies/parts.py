"""Parts of a file that holds several: files of a zip of single files, or sessions of a table with a column of them.

Each part is read as a file of its own.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, BinaryIO

from ml.formats.archive import Files, ZipFiles
from ml.formats.options import ArchiveLimits
from ml.formats.recording import FileReport, UndecodableFile
from ml.formats.registry import DEVICES, DeviceFormat
from ml.formats.source import Source
from ml.formats.tables import kind_of_text
from ml.formats.tables.cells.delimited import MAX_LINE, read_head, rows_behind, split_line
from ml.formats.tables.cells.numbers import MISSING, TIME_COLUMNS, NotANumber, column_name, parse_number, shown

SESSION_COLUMNS = frozenset({"session", "session_id", "session_no", "session_nr", "session_number", "run"})
"""Names of a column that says which session a row is of."""

TABLE_ENDINGS = (".csv", ".tsv", ".parquet")
FILE_ENDINGS = (".txt", ".json", ".xdf", ".edf", ".bdf", ".nwb")
"""Endings of files that a zip may hold; the columns of a table may be unknown as yet."""

HEAD = 65_536
MOST_SESSIONS = 500
MOST_LINES = 50_000_000
"""Lines that all parts of a table may have together."""

_CHUNK = 1 << 20
_EPOCH = (1980, 1, 1, 0, 0, 0)
_ZIP = (b"PK\x03\x04", b"PK\x05\x06")
_RESTART = "Count each session's times from its own start, or give each row its date and time."


@dataclass
class Parts:
    """Names of the parts in the zip of them, in order; and sentences on what of the file is no part."""

    names: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)


def find_parts(source: Source, sink: BinaryIO, limits: ArchiveLimits) -> Parts:
    """Write the parts of a file into a zip.

    Args:
        source: any file.
        sink: receives the zip, whose members are the parts; untouched where there are none. limits: bounds of an archive.

    Returns:
        The parts; none where the file is one recording, one table, or nothing that can be taken apart.

    Raises:
        UndecodableFile: a table with a column of sessions that does not separate them.
    """
    with source.open("rb") as stream:
        head = stream.read(HEAD)
    if head.startswith(_ZIP):
        return _members(source, sink, limits)
    if head.startswith(b"PAR1"):
        return _parquet(source, sink)
    if kind_of_text(source) != "csv":
        return Parts()
    return _text(source, sink)


def _members(source: Source, sink: BinaryIO, limits: ArchiveLimits) -> Parts:
    """Take the files of a zip of which no device's format reads the whole."""
    try:
        with ZipFiles(source, limits) as files:
            whole = [one for one in DEVICES if one.code.within(files, FileReport("archive"))]
            chosen = [name for name in files.names() if _is_part(files, name)]
            if not chosen or (whole and not _has_tables_too(files, chosen, whole)):
                return Parts()
            with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as out:
                for name in chosen:
                    with files.open(name) as stream, _member(out, name) as part:
                        _copy(stream, part)
            rest = len(files.names()) - len(chosen)
            ignored = [f"{rest} file{'s' if rest > 1 else ''} of the archive: neither a table nor a recording"] if rest else []
            return Parts(chosen, [*map(str, files.left_out), *ignored])
    except UndecodableFile:
        return Parts()  # reading the whole file reports its fault


def _has_tables_too(files: Files, names: Sequence[str], formats: Sequence[DeviceFormat]) -> bool:
    """Decide whether an archive has tables next to recordings that are one file each, so that a format would ignore the tables."""
    if not any(name.lower().endswith(TABLE_ENDINGS) for name in names):
        return False
    heads = [_head(files, name) for name in names if not name.lower().endswith(TABLE_ENDINGS)]
    return all(one.code.loose is None and any(map(one.code.begins, heads)) for one in formats)


def _head(files: Files, name: str) -> bytes:
    with files.open(name) as stream:
        return stream.read(HEAD)


def _is_part(files: Files, name: str) -> bool:
    """Decide whether a member of an archive is a table or a recording by itself."""
    ending = Path(name).suffix.lower()
    if ending in TABLE_ENDINGS:
        return True
    if ending not in FILE_ENDINGS:
        return False
    head = _head(files, name)
    if any((not one.magic or head.startswith(one.magic)) and one.code.begins(head) for one in DEVICES):
        return True
    lines = head.decode("utf-8", "replace").splitlines()[:20]
    return ending == ".txt" and any(column_name(cell)[0] in TIME_COLUMNS for line in lines for cell in re.split("[,;\t|]", line))


def _text(source: Source, sink: BinaryIO) -> Parts:
    """Take a text table apart by its column of sessions. A part keeps its rows on their lines, so that reports name those."""
    try:
        head = read_head(source, "t_s")
    except UndecodableFile:
        return Parts()  # no text: an archive, or a file that its own reader knows or refuses
    names = [column_name(header)[0] for header in head.headers]
    column = next((i for i, name in enumerate(names) if name in SESSION_COLUMNS), None)
    time = next((i for i, name in enumerate(names) if name in TIME_COLUMNS), None)
    if column is None or time is None:
        return Parts()
    rows: dict[str, list[tuple[int, str]]] = {}
    last = head.lines
    with rows_behind(source, head) as lines:
        for number, line in enumerate(lines, start=head.lines + 1):
            cells = split_line(line, head.delimiter)
            if not any(cells):
                continue
            session = cells[column] if column < len(cells) else ""
            if session.lower() in MISSING:
                stored = (f"a row of line {number} names no session", f"line {number}")
                where = f"line {number}, column {head.headers[column].strip()}"
                raise UndecodableFile("the row names no session", where, "Give every row its session, or leave it out.", *stored)
            rows.setdefault(session, []).append((number, line.rstrip("\r\n")))
            last = number
    if len(rows) < 2:
        return Parts()
    _check_count(len(rows), last)
    firsts = [split_line(of[0][1], head.delimiter)[time] for of in rows.values()]
    lasts = [split_line(of[-1][1], head.delimiter)[time] for of in rows.values()]
    _check_restart([_float(t) for t in firsts], [_float(t) for t in lasts], [of[0][0] for of in rows.values()])
    with _lines_above(source, head.encoding, head.lines) as above, zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as out:
        for session, own in rows.items():
            with _member(out, _name(session, "csv")) as part:
                part.write(above)
                at = head.lines + 1
                for number, line in own:
                    part.write(("\n" * (number - at) + line + "\n").encode())
                    at = number + 1
    return Parts([_name(session, "csv") for session in rows])


@contextmanager
def _lines_above(source: Source, encoding: str, count: int) -> Iterator[bytes]:
    """Yield the first lines of a text, in UTF-8."""
    with source.open("rb") as stream:
        content = stream.read(MAX_LINE).decode(encoding, "replace")
    yield "".join(f"{line}\n" for line in content.replace("\r\n", "\n").replace("\r", "\n").split("\n")[:count]).encode()


def _parquet(source: Source, sink: BinaryIO) -> Parts:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    try:
        with source.open("rb") as stream:
            table = pq.read_table(stream)
    except (pa.ArrowException, OSError, ValueError):
        return Parts()
    names = [column_name(name)[0] for name in table.column_names]
    column = next((table.column_names[i] for i, name in enumerate(names) if name in SESSION_COLUMNS), None)
    time = next((table.column_names[i] for i, name in enumerate(names) if name in TIME_COLUMNS), None)
    if column is None or time is None or len(found := pc.unique(table[column]).to_pylist()) < 2:
        return Parts()
    if None in found:
        raise UndecodableFile("a row names no session", f"column {column}", "Give every row its session.", None, "column of sessions")
    _check_count(len(found), table.num_rows)
    own = [table.filter(pc.equal(table[column], value)) for value in found]
    numeric = pa.types.is_integer(table.schema.field(time).type) or pa.types.is_floating(table.schema.field(time).type)
    if numeric:
        ends = [[_float(str(one[time][i].as_py())) for one in own] for i in (0, -1)]
        _check_restart(ends[0], ends[1], list(range(1, len(own) + 1)))
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as out:
        for value, one in zip(found, own, strict=True):
            with _member(out, _name(str(value), "parquet")) as part:
                pq.write_table(one, part)
    return Parts([_name(str(value), "parquet") for value in found])


def _check_count(sessions: int, lines: int) -> None:
    if sessions > MOST_SESSIONS or sessions * lines > MOST_LINES:
        hint = f"Split it into tables of at most {MOST_SESSIONS} sessions, each with fewer rows. Is this column that of the session?"
        raise UndecodableFile(f"a table of {sessions} sessions and {lines} lines", "column of sessions", hint)


def _check_restart(firsts: list[float | None], lasts: list[float | None], lines: list[int]) -> None:
    """Raise where times that are numbers run on from one session to the next: when a later one began is not known then."""
    for i in range(1, len(firsts)):
        before, first = lasts[i - 1], firsts[i]
        if before is not None and first is not None and first > before > 0:
            what = f"the times run on from one session to the next: {first:g} follows {before:g}"
            raise UndecodableFile(what, f"line {lines[i]}", _RESTART, "the times run on from one session to the next")


def _float(cell: str) -> float | None:
    try:
        return parse_number(cell, "," if "," in cell else ".")
    except NotANumber:
        return None


def name_part(session: str) -> str:
    """Name the part of a session, without its ending, by what the table calls it."""
    text = re.sub(r"[^\w+-]+", "_", shown(session.strip().removesuffix(".0")).strip("'\"")) or "_"
    return f"session {text}"


def _name(session: str, ending: str) -> str:
    return f"{name_part(session)}.{ending}"


@contextmanager
def _member(archive: zipfile.ZipFile, name: str) -> Iterator[IO[bytes]]:
    info = zipfile.ZipInfo(name, _EPOCH)
    info.create_system, info.external_attr, info.compress_type = 3, 0o100600 << 16, archive.compression
    with archive.open(info, "w", force_zip64=True) as out:
        yield out


def _copy(source: IO[bytes], target: IO[bytes]) -> None:
    while chunk := source.read(_CHUNK):
        target.write(chunk)
