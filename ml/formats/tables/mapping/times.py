"""Times of a mapped table, in the format and zone that a person stated."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from ml.formats.recording import UndecodableFile
from ml.formats.tables.cells.dates import ChangedClocks, in_zone, named_month, spreadsheet_date
from ml.formats.tables.cells.delimited import TextTable
from ml.formats.tables.cells.numbers import MISSING, NotANumber, parse_number, shown
from ml.formats.tables.mapping.model import RELATIVE, UNIX, WRITTEN, TableMapping, TimeFormat

_WRITTEN = re.compile(r"(\d{1,2})[./-](\d{1,2})[./-](\d{4})[T ,]+(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,6}))?)?", re.ASCII)
_SPAN_S = (datetime(1990, 1, 1, tzinfo=UTC).timestamp(), datetime(2200, 1, 1, tzinfo=UTC).timestamp())
EXAMPLES = {"iso": "2026-03-02 10:00:00", "dmy": "02.03.2026 10:00:00", "mdy": "03/02/2026 10:00:00", "excel": "46083.4166667"}


def is_absolute(time_format: TimeFormat) -> bool:
    """Decide whether times of a format are moments, not seconds from the session's start."""
    return time_format in UNIX or time_format in WRITTEN


def read_times(table: TextTable, column: int, mapping: TableMapping) -> NDArray[np.float64]:
    """Read a column of times, [rows]: Unix time in s where they are moments, else seconds from the session's start; NaN for empty cells.

    Raises:
        UndecodableFile: a cell of another format, a moment outside any study, or one that its zone has twice or never. It names the line.
    """
    if mapping.time_format in WRITTEN:
        out = np.array([_moment(row[column], table, i, column, mapping) for i, row in enumerate(table.rows)], dtype=np.float64)
    else:
        numbers = table.numbers(column, table.decimal_mark([column]), "time")
        if mapping.time_format == "samples":
            assert mapping.rate_hz is not None
            return numbers / mapping.rate_hz
        out = numbers * {**RELATIVE, **UNIX}[mapping.time_format]
    if is_absolute(mapping.time_format) and (off := np.flatnonzero((out < _SPAN_S[0]) | (out >= _SPAN_S[1]))).size:
        what, hint = "the time lies before 1990 or after 2200", "State in which format and unit the times are written."
        raise UndecodableFile(what, f"line {table.lines[off[0]]}, column {column + 1}", hint)
    return out


def _moment(cell: str, table: TextTable, row: int, column: int, mapping: TableMapping) -> float:
    text = cell.strip()
    if text.lower() in MISSING:
        return float("nan")
    try:
        found = _READ[mapping.time_format](text)
        if found.tzinfo is None:
            assert mapping.zone is not None
            found = in_zone(found, ZoneInfo(mapping.zone))
        return found.timestamp()
    except ChangedClocks as error:
        raise _changed_clocks(text, table.lines[row], column, mapping.zone or "") from error
    except (ValueError, OverflowError) as error:
        what = f"is no date and time written like {EXAMPLES[mapping.time_format]}"
        where = f"line {table.lines[row]}, column {column + 1}"
        hint = "State in which format the times are written, or give every row its date and time."
        raise UndecodableFile(f"{shown(text)} {what}", where, hint, f"a cell {what}") from error


def _changed_clocks(text: str, line: int, column: int, zone: str) -> UndecodableFile:
    what = f"is a time that the clocks of {zone} show twice or never, in the night in which they are changed"
    hint = "Write the times in UTC, or year first with their offset, such as 2026-10-25 02:30:00+02:00."
    return UndecodableFile(f"{shown(text)} {what}", f"line {line}, column {column + 1}", hint, f"a cell {what}")


def _day_or_month_first(text: str, which: str) -> datetime:
    """Parse a date with the year last, or with the name of its month. Raises ValueError."""
    if (named := named_month(text)) is not None:
        return named
    match = _WRITTEN.fullmatch(text)
    if match is None:
        raise ValueError("no date of this format")
    first, second, year, hour, minute, sec, part = match.groups()
    day, month = (first, second) if which == "dmy" else (second, first)
    return datetime(int(year), int(month), int(day), int(hour), int(minute), int(sec or 0), int((part or "0").ljust(6, "0")))


def _day_number(text: str) -> datetime:
    """Convert the day number of a spreadsheet. Raises ValueError."""
    try:
        days = parse_number(text, "," if "," in text else ".")
    except NotANumber as error:
        raise ValueError("no number") from error
    found = None if days is None else spreadsheet_date(days)
    if found is None:
        raise ValueError("no day number of this century")
    return found


_READ: dict[str, Callable[[str], datetime]] = {
    "iso": datetime.fromisoformat,
    "dmy": lambda text: _day_or_month_first(text, "dmy"),
    "mdy": lambda text: _day_or_month_first(text, "mdy"),
    "excel": _day_number,
}
