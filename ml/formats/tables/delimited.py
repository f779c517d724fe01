"""Text tables as people save them: comma, semicolon or tab, decimal point or comma, with or without a byte-order mark."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ml.formats.recording import UndecodableFile
from ml.formats.tables.numbers import NotANumber, parse_number, shown

MAX_LINE = 1_000_000
"""Characters a line may have: a longer one is no row of a table, and is not read into memory."""


@dataclass(slots=True)
class TextTable:
    """Header and rows of a text table.

    Attributes:
        headers: as they stand in the file.
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
        """The decimal mark used throughout these columns. Raises UndecodableFile where both are."""
        comma = self._first_with(",", columns)
        if comma is None:
            return "."
        point = self._first_with(".", columns)
        if point is not None and self.delimiter != ",":
            hint = "Use one decimal mark and no thousands separators."
            raise UndecodableFile("decimal points and commas in one table", f"line {max(comma, point)}", hint)
        return "." if point is not None else ","

    def _first_with(self, mark: str, columns: Sequence[int]) -> int | None:
        """Line of the first cell with this mark, formulas aside."""
        for line, row in zip(self.lines, self.rows, strict=True):
            if any(mark in row[i] and row[i].strip()[:1] not in "=@" for i in columns):
                return line
        return None

    def numbers(self, column: int, decimal: str, role: str | None = None) -> NDArray[np.float64]:
        """A column as numbers [rows], NaN for cells without one.

        `role` is what the column is called in a stored report, which must not repeat the file's own header.

        Raises:
            UndecodableFile: a cell holds text; names its line.
        """
        known = f"column {role}" if role else f"column number {column + 1}"
        cells = ((row[column], line) for row, line in zip(self.rows, self.lines, strict=True))
        return np.array([self._number(cell, decimal, line, column, known) for cell, line in cells], dtype=np.float64)

    def _number(self, cell: str, decimal: str, line: int, column: int, known: str) -> float:
        try:
            value = parse_number(cell, decimal)
        except NotANumber as error:
            where = f"line {line}, column {self.headers[column].strip()}"
            hint = "Put a number there, or leave the cell empty."
            what = f"{shown(cell.strip())} is text, not a number"
            raise UndecodableFile(what, where, hint, "a cell holds text, not a number", f"line {line}, {known}") from error
        return math.nan if value is None else value


def read_delimited(path: Path, max_rows: int | Callable[[Sequence[str]], int], needed: str) -> TextTable:
    """Read a text table.

    Args:
        path: the file.
        max_rows: rows it may have, or a function that says so by the headers.
        needed: the columns that are expected, for the message about an empty file.

    Raises:
        UndecodableFile: empty, binary, ragged or too long; names the line.
    """
    notes: list[str] = []
    with _open_text(path, notes, needed) as stream:
        source = _lines(stream)
        first = next(source, "")
        if first.lower().startswith("sep=") and len(first.strip()) == 5:
            delimiter, offset, first = first.strip()[4], 2, next(source, "")
        else:
            delimiter, offset = _delimiter(first), 1
        if not first.strip():
            raise UndecodableFile("the file is empty", "line 1", f"Upload a table with the columns {needed}.")
        try:
            headers = next(csv.reader([first], delimiter=delimiter))
        except csv.Error as error:
            raise UndecodableFile(f"not readable as a table: {error}", f"line {offset}", "Save the table as CSV (UTF-8).") from error
        most = max_rows if isinstance(max_rows, int) else max_rows(headers)
        lines, rows = _cells(source, delimiter, len(headers), offset, most)
    return TextTable(headers, lines, rows, delimiter, notes)


def _open_text(path: Path, notes: list[str], needed: str) -> io.TextIOWrapper:
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not head:
        raise UndecodableFile("the file is empty", "line 1", f"Upload a table with the columns {needed}.")
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        notes.append("text in UTF-16 read")
        encoding = "utf-16"
    elif b"\0" in head:
        raise UndecodableFile("this is a binary file, not a table of text", "first bytes", "Save the table as CSV (UTF-8) or Parquet.")
    else:
        encoding = "utf-8-sig"
    return io.TextIOWrapper(path.open("rb"), encoding=encoding, errors="replace", newline=None)


def _lines(stream: io.TextIOWrapper) -> Iterator[str]:
    """Lines of the text; raises on one too long to be a row."""
    number = 0
    while line := stream.readline(MAX_LINE):
        number += 1
        if len(line) == MAX_LINE and not line.endswith("\n"):
            hint = "Save the table as CSV (UTF-8), one row per line."
            raise UndecodableFile(f"a line of more than {MAX_LINE} characters", f"line {number}", hint)
        yield line


def _delimiter(header: str) -> str:
    return max("\t;,", key=lambda mark: (header.count(mark), mark != ","))


def _cells(source: Iterator[str], delimiter: str, width: int, offset: int, max_rows: int) -> tuple[list[int], list[list[str]]]:
    """Line numbers and cells of every row that is not blank."""
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


def read_headers(path: Path) -> list[str]:
    """The headers of a text table, nothing else of it; empty where there are none. Raises UndecodableFile for what is no text."""
    with _open_text(path, [], "t_s") as stream:
        source = _lines(stream)
        first = next(source, "")
        delimiter = _delimiter(first)
        if first.lower().startswith("sep=") and len(first.strip()) == 5:
            delimiter, first = first.strip()[4], next(source, "")
        try:
            return next(csv.reader([first], delimiter=delimiter), [])
        except csv.Error:
            return []
