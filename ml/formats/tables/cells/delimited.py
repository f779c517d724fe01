"""Text tables as people save them.

Commas, semicolons, tabs or pipes separate cells, with decimal points or commas. The text is UTF-8, UTF-16 (with or without a byte-order
mark) or Latin-1. Titles may come above the header, and a row of units below it.
"""

from __future__ import annotations

import codecs
import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from ml.formats.recording import UndecodableFile
from ml.formats.source import Source
from ml.formats.tables.cells.numbers import TIME_COLUMNS, TIME_UNITS, Grouping, NotANumber, column_name, known_unit, parse_number, shown

MOSTLY = 0.9
"""Share of the letters of a table that are Latin."""

MARKS = {".": "point", ",": "comma"}
MOST_TITLES = 20
"""Lines that may come above the header."""

TIME_HINT = "Give every time in seconds from the session's start, or as an ISO 8601 date and time with its zone."

MAX_LINE = 1_000_000
"""Characters a line may have: a longer one is no row of a table, and is not read into memory."""


@dataclass(slots=True)
class TextTable:
    """Header and rows of a text table.

    Attributes:
        headers: as in the file.
        lines: line number of each row.
        rows: cells, each row as long as the header.
        delimiter: what separates the cells.
        notes: what was adapted while reading, in sentences.
    """

    headers: list[str]
    lines: list[int]
    rows: list[list[str]]
    delimiter: str
    notes: list[str]

    def decimal_mark(self, columns: Sequence[int]) -> str:
        """Find the decimal mark used throughout these columns. Raises UndecodableFile where both are."""
        comma = self._first_with(",", columns)
        if comma is None:
            return "."
        point = self._first_with(".", columns)
        if point is not None and self.delimiter != ",":
            hint = "Use one decimal mark and no thousands separators."
            raise UndecodableFile("decimal points and commas in one table", f"line {max(comma, point)}", hint)
        return "." if point is not None else ","

    def _first_with(self, mark: str, columns: Sequence[int]) -> int | None:
        """Find the line of the first cell with this mark, formulas aside."""
        for line, row in zip(self.lines, self.rows, strict=True):
            if any(mark in row[i] and row[i].strip()[:1] not in "=@" for i in columns):
                return line
        return None

    def numbers(self, column: int, decimal: str, role: str | None = None) -> NDArray[np.float64]:
        """Read a column as numbers [rows], NaN for cells without one.

        `role` is what the column is called in a stored report, which must not repeat the file's own header.

        Raises:
            UndecodableFile: a cell holds text; names its line.
        """
        known = f"column {role}" if role else f"column number {column + 1}"
        grouping = Grouping(decimal)
        grouping.feed(row[column] for row in self.rows)
        if grouping.ambiguous(self.delimiter) and grouping.marked is not None:
            cell, line = self.rows[grouping.marked][column].strip(), self.lines[grouping.marked]
            plain = cell.replace(decimal, "")
            either = f"{shown(cell)} may mean {plain} or {cell.replace(',', '.')}"
            what = f"{either}: every {MARKS[decimal]} in the column has exactly three digits behind it"
            hint = f"Write {plain} without a thousands separator, or {cell}0 with another number of decimals."
            stored = "a number may have a thousands separator or three decimals"
            raise UndecodableFile(what, f"line {line}, column {self.headers[column].strip()}", hint, stored, f"line {line}, {known}")
        cells = ((row[column], line) for row, line in zip(self.rows, self.lines, strict=True))
        return np.array([self._number(cell, decimal, line, column, known) for cell, line in cells], dtype=np.float64)

    def _number(self, cell: str, decimal: str, line: int, column: int, known: str) -> float:
        try:
            value = parse_number(cell, decimal)
        except NotANumber as error:
            where = f"line {line}, column {self.headers[column].strip()}"
            hint = TIME_HINT if known == "column t_s" else "Put a number there, or leave the cell empty."
            what = f"{shown(cell.strip())} is text, not a number"
            raise UndecodableFile(what, where, hint, "a cell holds text, not a number", f"line {line}, {known}") from error
        return math.nan if value is None else value


@dataclass(frozen=True, slots=True)
class TableHead:
    """Head of a text table, above its rows.

    Attributes:
        headers: as in the file, with the unit of a row of units in brackets behind them.
        delimiter: what separates the cells.
        lines: how many lines to pass over before the first row.
        encoding: of the text.
        notes: what was adapted while reading, in sentences.
    """

    headers: list[str]
    delimiter: str
    lines: int
    encoding: str
    notes: list[str]


def read_delimited(path: Source, max_rows: int | Callable[[Sequence[str]], int], needed: str) -> TextTable:
    """Read a text table.

    Args:
        path: the file.
        max_rows: rows it may have, or a function that says so by the headers.
        needed: the columns that are expected, for the message about an empty file.

    Raises:
        UndecodableFile: empty, binary, ragged or too long; names the line.
    """
    head = read_head(path, needed)
    most = max_rows if isinstance(max_rows, int) else max_rows(head.headers)
    with rows_behind(path, head) as source:
        lines, rows = rows_of(source, head.delimiter, len(head.headers), head.lines, most)
    return TextTable(head.headers, lines, rows, head.delimiter, list(head.notes))


def read_head(path: Source, needed: str) -> TableHead:
    """Read the headers of a text table and how it is written. Raises UndecodableFile for an empty or a binary file."""
    notes: list[str] = []
    encoding = _encoding(path, notes, needed)
    with path.open("rb") as raw, io.TextIOWrapper(raw, encoding=encoding, errors="replace", newline=None) as stream:
        top = list(islice(_lines(stream), MOST_TITLES + 2))
    separator, skipped = None, 0
    if top and top[0].lower().startswith("sep=") and len(top[0].strip()) == 5:
        separator, skipped = top[0].strip()[4], 1
    at = _header_line(top, skipped, separator)
    first = top[at] if at < len(top) else ""
    if not first.strip():
        raise UndecodableFile("the file is empty", "line 1", f"Upload a table with the columns {needed}.")
    delimiter = separator or _delimiter(first)
    headers = _split(first, delimiter, at + 1)
    if at > skipped:
        notes.append(f"{at - skipped} line{'s' if at - skipped > 1 else ''} above the header passed over")
    below = top[at + 1] if at + 1 < len(top) else ""
    units = _units(below, delimiter, len(headers))
    if units:
        notes.append("the row of units below the header read as units")
        headers = [
            header if not unit or column_name(header)[1] else f"{header.strip()} [{unit}]"
            for header, unit in zip(headers, units, strict=True)
        ]
    return TableHead(headers, delimiter, at + 1 + bool(units), encoding, notes)


@contextmanager
def rows_behind(path: Source, head: TableHead) -> Iterator[Iterator[str]]:
    """Yield the lines below the head of a table."""
    with path.open("rb") as raw, io.TextIOWrapper(raw, encoding=head.encoding, errors="replace", newline=None) as stream:
        lines = _lines(stream)
        for _ in islice(lines, head.lines):
            pass
        yield lines


@contextmanager
def text_lines(path: Source, needed: str) -> Iterator[Iterator[str]]:
    """Yield the lines of a text table from its first one. Raises UndecodableFile for an empty or a binary file."""
    encoding = _encoding(path, [], needed)
    with path.open("rb") as raw, io.TextIOWrapper(raw, encoding=encoding, errors="replace", newline=None) as stream:
        yield _lines(stream)


def _header_line(top: list[str], begin: int, separator: str | None) -> int:
    """Find the first line that names a column of times; the first line where none of the top does."""
    for i, line in enumerate(top[begin : begin + MOST_TITLES + 1], start=begin):
        try:
            cells = next(csv.reader([line], delimiter=separator or _delimiter(line)), [])
        except csv.Error:
            continue
        if any(column_name(cell)[0] in TIME_COLUMNS for cell in cells):
            return i
    return begin


def split_line(line: str, delimiter: str) -> list[str]:
    """Split one line into cells, without line end or blanks around them; empty for a line that is no row of a table."""
    try:
        return [cell.strip() for cell in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter), [])]
    except csv.Error:
        return []


def _split(line: str, delimiter: str, number: int) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=delimiter))
    except csv.Error as error:
        raise UndecodableFile(f"not readable as a table: {error}", f"line {number}", "Save the table as CSV (UTF-8).") from error


def _units(line: str, delimiter: str, width: int) -> list[str] | None:
    """Read the units of a row below the header that has nothing else; None for every other row."""
    try:
        cells = [cell.strip().strip("[]()").strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return None
    named = [cell for cell in cells if cell not in ("", "-")]
    if len(cells) != width or not named or not all(known_unit(cell) or cell.lower() in TIME_UNITS for cell in named):
        return None
    return ["" if cell == "-" else cell for cell in cells]


def _encoding(path: Source, notes: list[str], needed: str) -> str:
    """Detect the encoding of the text by its first bytes. Raises UndecodableFile for what is no text."""
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not head:
        raise UndecodableFile("the file is empty", "line 1", f"Upload a table with the columns {needed}.")
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        notes.append("text in UTF-16 read")
        return "utf-16"
    if b"\0" in head:
        if (order := utf16_without_mark(head)) is not None:
            notes.append("text in UTF-16 read")
            return order
        raise UndecodableFile("this is a binary file, not a table of text", "first bytes", "Save the table as CSV (UTF-8) or Parquet.")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        notes.append("text in Latin-1 read")
        return "cp1252"
    return "utf-8-sig"


def utf16_without_mark(head: bytes) -> str | None:
    """Detect UTF-16 in a text that does not begin with a mark: of Latin letters every other byte is 0. None for anything else."""
    for encoding, zeros, letters in (("utf-16-le", head[1::2], head[0::2]), ("utf-16-be", head[0::2], head[1::2])):
        if zeros and zeros.count(0) >= MOSTLY * len(zeros) and 0 not in letters:
            return encoding
    return None


def _lines(stream: io.TextIOWrapper) -> Iterator[str]:
    """Yield lines of the text; raises on one too long to be a row."""
    number = 0
    while line := stream.readline(MAX_LINE):
        number += 1
        if len(line) == MAX_LINE and not line.endswith("\n"):
            hint = "Save the table as CSV (UTF-8), one row per line."
            raise UndecodableFile(f"a line of more than {MAX_LINE} characters", f"line {number}", hint)
        yield line


def _delimiter(header: str) -> str:
    return max("\t;|,", key=lambda mark: (header.count(mark), mark != ","))


def rows_of(source: Iterator[str], delimiter: str, width: int, offset: int, max_rows: int) -> tuple[list[int], list[list[str]]]:
    """Read line numbers and cells of every row that is not blank, of lines of which the first has the number `offset` + 1.

    Raises:
        UndecodableFile: a row of another width, more than `max_rows`, no table; names the line.
    """
    reader = csv.reader(source, delimiter=delimiter)
    lines: list[int] = []
    rows: list[list[str]] = []
    number = offset
    try:
        for row in reader:
            number = offset + reader.line_num
            if not any(cell.strip() for cell in row):
                continue
            while len(row) > width and not row[-1].strip():
                row.pop()
            if len(row) != width:
                hint = "Give every row one cell per column; with decimal commas separate the columns by semicolons."
                raise UndecodableFile(f"{len(row)} cells where the header has {width}", f"line {number}", hint)
            lines.append(number)
            rows.append(row)
            if len(rows) > max_rows:
                raise UndecodableFile(f"more than {max_rows} rows", f"line {number}", "Upload one session per table.")
    except csv.Error as error:
        raise UndecodableFile(f"not readable as a table: {error}", f"line {number + 1}", "Save the table as CSV (UTF-8).") from error
    return lines, rows


def read_headers(path: Source) -> list[str]:
    """Read the headers of a text table, nothing else of it; empty where there are none. Raises UndecodableFile for what is no text."""
    return read_head(path, "t_s").headers
