"""Columns of a table: which header means what, in which unit, and their cells as numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ml.formats.options import DecodeOptions
from ml.formats.recording import UndecodableFile
from ml.formats.source import Source
from ml.formats.tables.cells.dates import written_s, zone_named
from ml.formats.tables.cells.delimited import TextTable, read_delimited, read_head, rows_behind
from ml.formats.tables.cells.numbers import MISSING, column_name, known_unit, shown, unit_name
from ml.formats.tables.cells.plain import read_plain

TIME_NAMES = ("t_s", "t", "time_s", "time", "seconds", "t_sec", "timestamp", "datetime", "date_time", "time_utc")
MILLISECOND_NAMES = ("t_ms", "time_ms", "milliseconds")
BETA_NAMES = ("beta", "p_beta", "beta_amplitude", "beta_power")
LFP_NAMES = ("lfp", "raw_lfp", "lfp_raw", "local_field_potential")
LFP_SCALE = {"nV": 1e-3, "uV": 1.0, "mV": 1e3, "V": 1e6}
"""How many uV one of the unit is."""
FRACTION_NAMES = ("amplitude_fraction", "fraction", "amp_fraction", "stim_fraction", "a")
MILLIAMP_NAMES = ("amplitude_ma", "amp_ma", "stim_ma", "ma", "milliamps", "amplitude_milliamps")
AMPLITUDE_NAMES = ("amplitude", "amp", "stimulation")
"""Names that say what the column holds only together with a unit."""
TIME_SCALE = {None: 1.0, "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3}
PER_UNIT: dict[str, dict[str | None, float]] = {
    "amplitude_ma": {None: 1.0, "mA": 1.0, "uA": 1000.0, "A": 1e-3},
    "amplitude_fraction": {None: 1.0, "fraction": 1.0, "%": 100.0},
}
"""How many of the header's unit make 1 mA, or the fraction 1."""
CLOCK_CHANGE_SPREAD_S = 600.0
"""Dates that go back by an hour, give or take so much, are those of a clock that was changed."""
LONGEST_TABLE_S = 7 * 86_400.0
"""No session's table reaches further from the session's start, before it or after it."""
LATEST_FIRST_S = 3600.0
"""No session begins an hour before its first row."""

LATE_FIRST_S = 120.0
"""A session whose first row comes later, and after more time than its rows span, is likely of another clock."""

LONGEST_SESSION_S = 86_400.0
"""No session of a visit lasts longer than a day."""

_UNIX_SPAN_S = (datetime(1990, 1, 1, tzinfo=UTC).timestamp(), datetime(2200, 1, 1, tzinfo=UTC).timestamp())
_UNIX_UNITS = (("seconds", 1.0), ("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
LOG_KIND_LINE = "# betaloop controller log, version 1, period 2 s"
LOG_COLUMNS = frozenset({"requested_ma", "action", "reasons", "latency_us", "signal_us", "late_ms", "missed"})
"""Columns that nothing but a controller's log has."""
NEEDED = "t_s, beta and amplitude_fraction (or amplitude_ma), or t_s and lfp with its unit"


@dataclass(slots=True)
class Columns:
    """Columns found, as they are called in the file, and their cells in the header's unit as float64 [n] with NaN for missing."""

    names: dict[str, str]
    units: dict[str, str | None]
    lines: NDArray[np.int64]
    values: dict[str, NDArray[np.float64]]
    ignored: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def label(self, role: str) -> str:
        """Name the column as a stored file or report may: its role and the unit in brackets."""
        unit = self.units[role]
        return f"{role} [{unit}]" if unit else role

    def error(self, what: str, role: str, hint: str, row: int | None = None, stored: str | None = None) -> UndecodableFile:
        """Make an error at a column, and at the line of a row; `stored` is the text without the file's own words."""
        line = "" if row is None else f"line {self.lines[row]}, "
        return UndecodableFile(what, f"{line}column {self.names[role]}", hint, stored, f"{line}column {role}")


def check_reach(t_s: NDArray[np.float64], columns: Columns) -> None:
    """Raise where times lie days away from the session's start, before anything is made whose size follows from them.

    Args:
        t_s: times in s from the session's start, [n], increasing, none missing, n >= 1.
        columns: the table, for the error.

    Raises:
        UndecodableFile: Unix times, named as such, or times of more than a week before or after the start.
    """
    far = np.flatnonzero(np.abs(t_s) > LONGEST_TABLE_S)
    if far.size == 0:
        _check_start(t_s, columns)
        return
    row, hint = int(far[0]), "Give t_s in seconds from the session's start, one session per table: rows before the start are negative."
    written = float(columns.values["t_s"][row])
    for unit, per_second in _UNIX_UNITS:
        seconds = written / per_second
        if _UNIX_SPAN_S[0] <= seconds <= _UNIX_SPAN_S[1]:
            when = f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"
            what = f"the times are Unix {unit} ({written:.15g} is {when}), not seconds from the session's start"
            hint = f"{hint} Subtract the time at which the controller was started, and state that time as the start of the session."
            raise columns.error(what, "t_s", hint, row)
    what = f"{t_s[row]:.9g} s lies more than a week from the session's start, t_s 0"
    raise columns.error(what, "t_s", hint, row)


def _check_start(t_s: NDArray[np.float64], columns: Columns) -> None:
    """Raise where the first row comes so late, or rows are so rare, that the times are likely of another clock or unit."""
    if t_s[0] > LATEST_FIRST_S:
        hours, minutes = divmod(round(float(t_s[0]) / 60), 60)
        what = f"the first row lies {t_s[0] / 3600:.3g} h after the session's start, t_s 0"
        hint = (
            "Give t_s in seconds from the session's start. If these are seconds of the day, subtract the time of day at which the session "
            f"started (the first row would be at {hours:02d}:{minutes:02d})."
        )
        raise columns.error(what, "t_s", hint, 0)
    if t_s[0] > LATE_FIRST_S and t_s[0] > t_s[-1] - t_s[0]:
        what = f"the first row comes {t_s[0]:.6g} s after the session's start, t_s 0, and the rows span {t_s[-1] - t_s[0]:.6g} s"
        hint = "Give t_s in seconds from the session's start. If it counts from another moment, such as the device's start, subtract that."
        raise columns.error(what, "t_s", hint, 0)
    if t_s[-1] - max(0.0, float(t_s[0])) > LONGEST_SESSION_S:
        what = f"the session would last {(t_s[-1] - max(0.0, float(t_s[0]))) / 3600:.3g} h"
        hint = "Give t_s in seconds, one session per table. If these are milliseconds, name the column t_ms."
        raise columns.error(what, "t_s", hint, t_s.size - 1)


def match_columns(headers: Sequence[str]) -> tuple[dict[str, int], dict[str, str | None], list[str], list[str]]:
    """Match headers to roles: role -> index, role -> unit, the headers of no use, and sentences about what was adapted.

    Raises:
        UndecodableFile: a needed column is missing, named twice or in an unknown unit.
    """
    _refuse_log(headers)
    found: dict[str, int] = {}
    units: dict[str, str | None] = {}
    unused: list[str] = []
    notes: list[str] = []
    for index, header in enumerate(headers):
        key, unit = column_name(header)
        role = _role(key, unit)
        if role is None:
            unused.append(header.strip())
            continue
        if role in found:
            what = f"two columns both give {role}"
            raise UndecodableFile(f"{what}: {shown(headers[found[role]])} and {shown(header)}", "line 1", "Keep one of them.", what)
        found[role], units[role] = index, _header_unit(role, unit, header, notes)
    _check_complete(found, headers)
    return found, units, unused, notes


def _refuse_log(headers: Sequence[str]) -> None:
    """Raise for a controller's log without its kind line: read as a table of steps, every amplitude would be one step too early."""
    if len(LOG_COLUMNS & {column_name(h)[0] for h in headers}) >= 2:
        raise UndecodableFile(
            "this looks like the log of a controller without its first line, which says so: each of its rows has the beta of the step that "
            "ended and the amplitude of the next one, not of the same step",
            "line 1",
            f"Upload the log as the controller wrote it, with its first line '{LOG_KIND_LINE}'. A table of steps has no such columns: "
            "leave them out.",
        )


def _check_complete(found: dict[str, int], headers: Sequence[str]) -> None:
    """Raise where a needed column is missing, naming its unit as the reason where that is all that is wrong."""
    if "lfp" in found and "beta" in found:
        what = "the table has both lfp and beta"
        raise UndecodableFile(what, "line 1", "Upload either raw LFP, or beta per step: the service makes beta from LFP itself.")
    missing = [role for role in ("t_s", "beta") if role not in found and not (role == "beta" and "lfp" in found)]
    if "lfp" not in found and "amplitude_fraction" not in found and "amplitude_ma" not in found:
        for header in headers:
            key, unit = column_name(header)
            if key in AMPLITUDE_NAMES and unit:
                raise _unknown_unit("amplitude_ma", unit, header)
        missing.append("amplitude_fraction (or amplitude_ma)")
    if missing:
        names = ", ".join(shown(h.strip()) for h in headers[:20]) or "none"
        what = f"missing column {', '.join(missing)}"
        raise UndecodableFile(f"{what}; found: {names}", "line 1", f"Name the columns {NEEDED}.", what)


def _role(key: str, unit: str | None) -> str | None:
    if key in TIME_NAMES or key in MILLISECOND_NAMES:
        return "t_s"
    if key in BETA_NAMES:
        return "beta"
    if _is_lfp(key):
        return "lfp"
    if key in MILLIAMP_NAMES:
        return "amplitude_ma"
    if key in FRACTION_NAMES:
        return "amplitude_fraction"
    if key in AMPLITUDE_NAMES and unit is not None:
        return next((role for role, known in PER_UNIT.items() if unit_name(unit) in known), None)
    return None


def _is_lfp(key: str) -> bool:
    return key in LFP_NAMES or _lfp_suffix(key) is not None


def _lfp_suffix(key: str) -> str | None:
    """Find the unit that a name like `lfp_uv` ends with."""
    return next((unit for unit in LFP_SCALE if key == f"lfp_{unit.lower()}"), None)


def is_lfp(headers: Sequence[str]) -> bool:
    """Decide whether a table with these headers has raw LFP."""
    return any(_is_lfp(column_name(header)[0]) for header in headers)


def _header_unit(role: str, unit: str | None, header: str, notes: list[str]) -> str | None:
    """Read the unit of a column in its one spelling. Raises UndecodableFile for a unit that its numbers cannot be converted from."""
    if unit is None:
        return "ms" if column_name(header)[0] in MILLISECOND_NAMES else _lfp_suffix(column_name(header)[0])
    if role == "lfp":
        if unit_name(unit) not in LFP_SCALE:
            raise _unknown_unit(role, unit, header)
        return unit_name(unit)
    if role == "t_s":
        if zone_named(unit) is not None:
            return None  # times count from the first row, whatever their zone
        if unit.lower() not in TIME_SCALE:
            raise _unknown_unit(role, unit, header)
        return unit.lower()
    if role in PER_UNIT:
        if unit_name(unit) not in PER_UNIT[role]:
            raise _unknown_unit(role, unit, header)
        return unit_name(unit)
    known = known_unit(unit)
    if known is None:
        notes.append("the text in brackets after beta is no unit known here: beta was read as if its header stated none")
    return known


def _unknown_unit(role: str, unit: str, header: str) -> UndecodableFile:
    hint = {
        "t_s": "Give the time in seconds (s).",
        "lfp": "Give the LFP in uV, and say so in the header: lfp [uV]. nV, mV and V are converted.",
        "amplitude_ma": "Give the amplitude in mA, and say so in the header: amplitude (mA). uA and A are converted.",
        "amplitude_fraction": "Give the fraction of the cDBS amplitude, 0 to 1, or percent with the header amplitude_fraction (%).",
    }[role]
    column = {"t_s": "time", "lfp": "LFP"}.get(role, "amplitude")
    what = f"unknown unit {shown(unit)} of the {column} column"
    return UndecodableFile(what, f"column {header.strip()}", hint, f"unknown unit of the {column} column", f"column {role}")


def read_csv(path: Source, options: DecodeOptions) -> Columns:
    """Read the cells of a text table; see `decode_csv`."""
    head = read_head(path, NEEDED)
    found, units, unused, notes = match_columns(head.headers)
    names = {role: head.headers[index].strip() for role, index in found.items()}
    most = options.max_lfp_rows if is_lfp(head.headers) else options.max_table_rows
    with rows_behind(path, head) as lines:
        plain = read_plain(lines, head.delimiter, len(head.headers), list(found.values()), most)
    if plain is not None:
        values = {role: plain[index] for role, index in found.items()}
        rows = head.lines + 1 + np.arange(values["t_s"].size, dtype=np.int64)
        return Columns(names, units, rows, values, unused, [*head.notes, *notes])
    table = read_delimited(path, most, NEEDED)
    table.notes.extend(notes)
    dates = _dates(table, found["t_s"], 0.0 if "lfp" in found else options.period_s)
    numeric = {role: index for role, index in found.items() if role != "t_s" or dates is None}
    decimal = table.decimal_mark(list(numeric.values()))
    if decimal == ",":
        table.notes.append("decimal comma read as decimal point")
    values = {role: table.numbers(index, decimal, role) for role, index in numeric.items()}
    if dates is not None:
        values, units["t_s"] = {"t_s": dates} | values, None
        table.notes.append(
            "the times are dates: read as seconds from the first row, where the session is taken to start; state its start with the upload"
        )
    return Columns(names, units, np.array(table.lines, dtype=np.int64), values, unused, table.notes)


def _dates(table: TextTable, column: int, first_s: float) -> NDArray[np.float64] | None:
    """Read a column of ISO 8601 dates as seconds, [rows], of which the first is `first_s`. NaN for empty cells, None where it has no
    dates."""
    first = next((row[column] for row in table.rows if row[column].strip().lower() not in MISSING), "")
    if written_s(first) is None:
        return None
    out = np.full(len(table.rows), np.nan)
    for i, row in enumerate(table.rows):
        cell = row[column].strip()
        moment = written_s(cell)
        if moment is None and cell.lower() not in MISSING:
            where, hint = (
                f"line {table.lines[i]}, column {table.headers[column].strip()}",
                "Give every time as ISO 8601, or every time in seconds.",
            )
            raise UndecodableFile(f"{shown(cell)} is no date", where, hint, "a cell holds no date", f"line {table.lines[i]}, column t_s")
        out[i] = np.nan if moment is None else moment
    _refuse_changed_clock(out, table, column)
    known = out[np.isfinite(out)]
    return out - known[0] + first_s


def _refuse_changed_clock(unix_s: NDArray[np.float64], table: TextTable, column: int) -> None:
    """Raise where dates go back by about an hour: the clocks were changed, and a date without its zone means two moments."""
    back = np.flatnonzero(np.abs(np.diff(unix_s) + 3600.0) <= CLOCK_CHANGE_SPREAD_S)
    if back.size:
        line = f"line {table.lines[int(back[0]) + 1]}"
        what, hint = (
            "the times go back by an hour",
            "Where the clocks were changed in that night, write every time with its zone, such as +01:00.",
        )
        raise UndecodableFile(what, f"{line}, column {table.headers[column].strip()}", hint, what, f"{line}, column t_s")


def read_parquet(path: Source, options: DecodeOptions) -> Columns:
    """Read the columns of a Parquet table; see `decode_parquet`."""
    with path.open("rb") as stream:
        return _parquet_columns(stream, options)


def _parquet_columns(stream: BinaryIO, options: DecodeOptions) -> Columns:
    import pyarrow as pa
    import pyarrow.parquet as pq

    hint = "Write the table again, for example with pandas' to_parquet."
    try:
        file = pq.ParquetFile(stream)
        headers = [str(n) for n in file.schema_arrow.names]
    except (pa.ArrowException, OSError, ValueError) as error:
        raise UndecodableFile("the Parquet file is damaged or cut", "file", hint) from error
    most = options.max_lfp_rows if is_lfp(headers) else options.max_table_rows
    if file.metadata.num_rows > most:
        raise UndecodableFile(f"more than {most} rows", "file", "Upload one session per table.")
    schema = file.schema_arrow
    found, units, unused, notes = match_columns([_with_unit(schema.field(i)) for i in range(len(headers))])
    for role, index in found.items():
        kind = schema.field(index).type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind) or pa.types.is_null(kind)):
            what, where = f"the column holds {kind}, not numbers", f"column {headers[index]}"
            raise UndecodableFile(what, where, "Store it as float64.", "the column holds no numbers", f"column {role}")
    try:
        table = file.read(columns=[headers[i] for i in found.values()])
        values = {role: _arrow_floats(table.column(headers[i])) for role, i in found.items()}
    except (pa.ArrowException, OSError, ValueError) as error:
        raise UndecodableFile("the Parquet file is damaged or cut", "file", hint) from error
    lines = np.arange(1, table.num_rows + 1, dtype=np.int64)
    return Columns({role: headers[i] for role, i in found.items()}, units, lines, values, unused, notes)


def _with_unit(column: Any) -> str:
    """Return a Parquet column's header, with the unit of its metadata in brackets where the header itself states none."""
    header = str(column.name)
    unit = (column.metadata or {}).get(b"unit", b"").decode("utf-8", "replace").strip()
    if not unit or column_name(header)[1] is not None or set(unit) & set("()[]"):
        return header
    return f"{header} [{unit}]"


def _arrow_floats(column: object) -> NDArray[np.float64]:
    import pyarrow as pa

    floats = column.cast(pa.float64()).to_numpy()  # type: ignore[attr-defined]
    floats = np.array(floats, dtype=np.float64)
    floats[~np.isfinite(floats)] = np.nan
    return floats
