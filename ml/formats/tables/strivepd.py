"""Minutes of tremor: StrivePD exports, wide (shares per class) and long (seconds per severity), Apple's results, one class per minute.

Source: format notes, A″.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo

import numpy as np
from numpy.typing import NDArray

from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, FileReport, OutcomeLog, UndecodableFile
from ml.formats.source import Source
from ml.formats.tables.cells.dates import ChangedClocks, in_zone, named_month, spreadsheet_date, zone_of_header
from ml.formats.tables.cells.delimited import TextTable, read_delimited
from ml.formats.tables.cells.numbers import NotANumber, column_name, parse_number, shown
from ml.formats.tables.outcome_table import OutcomeTable, cell
from ml.formats.tables.removed import removed_columns
from ml.qoc import TREMOR_CLASSES

SUMMARY = "all"
"""slight + mild + moderate + strong of the same minute: no class of its own, never added to the others."""

MINUTE_S = 60.0
SUM_TOLERANCE = 0.02
EARLIEST_UNIX_S = 1e9
"""September 2001: no watch measured tremor before, so a smaller number is no date."""

LATEST_UNIX_S = 1e10
TIME_NAMES = ("time", "minute_start", "start_utc", "minute_start_utc", "start", "start_time", "timestamp", "start_date", "startdate")
END_NAMES = ("enddate", "end_date", "end", "end_time", "end_utc")
LONGEST_S = 3600.0
"""Longest interval of a watch, which measures minutes; a longer one is no measurement."""

CLASS_NAMES = ("class", "tremor_class", "tremor")
KNOWN = frozenset(
    {*TREMOR_CLASSES, "severity", "duration", "duration_s", "measurement_duration_ns", "stream_type_id", "measurement", "any_tremor"}
)
_SHARE = re.compile(r"^(percent|fraction|share)|(percent|pct|fraction|share)$")
WANTED = ", ".join(TREMOR_CLASSES)


MEASURED = "minutes of tremor"
"""Measurements of a `TremorLog`, in words."""


@dataclass(frozen=True, slots=True, eq=False)
class TremorLog(OutcomeLog):
    """Minutes of tremor in time order, in UTC.

    Attributes:
        start_unix_s: begin of each minute, shape [n].
        duration_s: length of each minute's measurement, shape [n].
        fractions: share per class in the order of `TREMOR_CLASSES`, shape [n, 6]; NaN where the export does not split the tremor.
        any_tremor: share with slight or worse tremor, shape [n]; NaN where not known.
    """

    start_unix_s: NDArray[np.float64]
    duration_s: NDArray[np.float64]
    fractions: NDArray[np.float64]
    any_tremor: NDArray[np.float64]


def looks_like_tremor(headers: Sequence[str]) -> bool:
    """Check whether a table with these headers holds minutes of tremor."""
    keys = {_key(header) for header in headers}
    named = {"mild", "moderate", "strong"} <= keys or "severity" in keys
    return named or (bool(keys & set(CLASS_NAMES)) and bool(keys & set(TIME_NAMES)))


def _key(header: str) -> str:
    """Name a column; by its class where it is called like Apple's `percentMild`, or `mild_percent`."""
    key = column_name(header)[0]
    plain = _SHARE.sub("", key).strip("_")
    return plain if plain in TREMOR_CLASSES else key


def decode_strivepd(path: Source, options: DecodeOptions | None = None, name: str | None = None) -> DecodedFile:
    """Decode minutes of tremor in any of three layouts, recognised by their columns.

    Times are ISO 8601 or Unix time; a time without a zone is read as UTC, and reported.

    Raises:
        UndecodableFile: none of the layouts, text for a number, an unreadable time; names line and column.
    """
    table = read_delimited(path, (options or DecodeOptions()).max_table_rows, "time and one column per class")
    columns = {_key(header): i for i, header in reversed(list(enumerate(table.headers)))}
    report = FileReport(name or path.name)
    report.repaired.extend(table.notes)
    time = next((columns[key] for key in TIME_NAMES if key in columns), None)
    if time is None:
        found = ", ".join(shown(h.strip()) for h in table.headers[:20])
        what = "no column of times"
        raise UndecodableFile(f"{what}; found: {found}", "line 1", "Name it time or minute_start.", what)
    of_class = next((columns[key] for key in CLASS_NAMES if key in columns), None)
    used = {time, *(i for key, i in columns.items() if key in KNOWN or key in END_NAMES)}
    if set(TREMOR_CLASSES) <= set(columns):
        minutes = _wide(table, columns, time, report)
    elif {"severity", "duration"} <= set(columns):
        minutes = _long(table, columns, time, report)
    elif of_class is not None:
        minutes = _by_class(table, columns, time, of_class, report)
        used.add(of_class)
    else:
        hint = f"A wide export has the columns time, {WANTED}; a long one time, severity, duration; a table per minute minute_start, class."
        raise UndecodableFile("no layout of a tremor export", "line 1", hint)
    report.removed.extend(removed_columns(header for i, header in enumerate(table.headers) if i not in used))
    if minutes.start_unix_s.size == 0:
        raise UndecodableFile("the table holds no minute of tremor", "after line 1", "Upload the export as StrivePD wrote it.")
    report.understood.append(f"{minutes.start_unix_s.size} {MEASURED}")
    return DecodedFile((), (report,), outcomes=(minutes,))


def _wide(table: TextTable, columns: dict[str, int], time: int, report: FileReport) -> TremorLog:
    decimal = table.decimal_mark([columns[c] for c in TREMOR_CLASSES])
    start = _starts(table, time, report)
    fractions = np.column_stack([table.numbers(columns[c], decimal, c) for c in TREMOR_CLASSES]) if table.rows else np.empty((0, 6))
    stated = table.numbers(columns["any_tremor"], decimal, "any_tremor") if "any_tremor" in columns else np.full(start.size, np.nan)
    sums = fractions.sum(axis=1)
    whole = sums[np.isfinite(sums)]  # a minute with an empty cell does not say what the others are in
    if whole.size and abs(float(np.median(whole)) - 100.0) <= 100.0 * SUM_TOLERANCE:
        fractions, stated = fractions / 100.0, stated / 100.0
        report.repaired.append("shares in per cent read as fractions")
    outside = np.flatnonzero(((fractions < 0) | (fractions > 1 + SUM_TOLERANCE)).any(axis=1))
    if outside.size:
        line = f"line {table.lines[outside[0]]}"
        hint = "Upload the export as the watch's app wrote it: the classes of a minute add up to 1, or to 100 in every row."
        raise UndecodableFile("a fraction outside 0 to 1", line, hint)
    off = np.abs(fractions.sum(axis=1) - 1.0) > SUM_TOLERANCE
    if count := int(off.sum()):
        report.flagged.append(f"{count} minutes whose fractions do not add up to 1: kept as they are")
    any_tremor = np.where(np.isfinite(stated), stated, fractions[:, 2:].sum(axis=1))
    return _in_order(start, _lengths(table, columns, time, start), fractions, any_tremor, report)


def _lengths(table: TextTable, columns: dict[str, int], time: int, start: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the length of each row's minute, s: stated, or up to its end; 60 where the table lacks it."""
    end = next((columns[key] for key in END_NAMES if key in columns), None)
    if "duration_s" not in columns and end is not None:
        zone = zone_of_header(table.headers[end]) or zone_of_header(table.headers[time])
        ends = np.array([_unix_s(row[end], line, zone)[0] for row, line in zip(table.rows, table.lines, strict=True)], dtype=np.float64)
        if (odd := np.flatnonzero((ends <= start) | (ends - start > LONGEST_S))).size:
            where = f"line {table.lines[odd[0]]}, column {table.headers[end].strip()}"
            what, hint = (
                "an interval that ends before it begins, or lasts more than an hour",
                "Upload the export as the watch's app wrote it.",
            )
            raise UndecodableFile(what, where, hint, what, f"line {table.lines[odd[0]]}, column end")
        return ends - start
    if "duration_s" not in columns:
        return np.full(len(table.rows), MINUTE_S)
    length = table.numbers(columns["duration_s"], table.decimal_mark([columns["duration_s"]]), "duration_s")
    return np.where(length > 0, length, MINUTE_S)


def _by_class(table: TextTable, columns: dict[str, int], time: int, of_class: int, report: FileReport) -> TremorLog:
    """Read one class per minute: that class has the whole minute."""
    start = _starts(table, time, report)
    fractions = np.zeros((start.size, len(TREMOR_CLASSES)))
    for i, (row, line) in enumerate(zip(table.rows, table.lines, strict=True)):
        name = row[of_class].strip().lower()
        if name not in TREMOR_CLASSES:
            where = f"line {line}, column {table.headers[of_class].strip()}"
            what = "no class of tremor"
            raise UndecodableFile(f"{shown(name)} is {what}", where, f"Write one of {WANTED}.", what, f"line {line}, column class")
        fractions[i, TREMOR_CLASSES.index(name)] = 1.0
    return _in_order(start, _lengths(table, columns, time, start), fractions, fractions[:, 2:].sum(axis=1), report)


def _long(table: TextTable, columns: dict[str, int], time: int, report: FileReport) -> TremorLog:
    """Gather rows of seconds per severity by minute; rows of percentages repeat them and are ignored."""
    seconds: dict[float, dict[str, float]] = defaultdict(dict)
    lengths: dict[float, float] = {}
    durations = table.numbers(columns["duration"], table.decimal_mark([columns["duration"]]), "duration")
    length_ns = table.numbers(columns["measurement_duration_ns"], ".", "length") if "measurement_duration_ns" in columns else None
    starts = _starts(table, time, report)
    skipped = 0
    for i, row in enumerate(table.rows):
        severity = row[columns["severity"]].strip().lower()
        if severity not in (*TREMOR_CLASSES, SUMMARY) or not _is_tremor_duration(row, columns) or not durations[i] >= 0:
            skipped += 1
            continue
        start = float(starts[i])
        if seconds[start].setdefault(severity, float(durations[i])) != durations[i]:
            what = f"two rows give {severity} of one minute differently"
            raise UndecodableFile(what, f"line {table.lines[i]}", "Keep one of them; a table holds the minutes of one watch.")
        lengths[start] = MINUTE_S if length_ns is None or not length_ns[i] > 0 else float(length_ns[i]) / 1e9
    if skipped:
        report.ignored.append(f"{skipped} rows that are no seconds of tremor")
    start_s = np.array(sorted(seconds), dtype=np.float64)
    length = np.array([lengths[t] for t in start_s], dtype=np.float64)
    table_s = [[_class_seconds(seconds[t], c) for c in TREMOR_CLASSES] for t in start_s]
    fractions = np.array(table_s, dtype=np.float64).reshape(-1, 6) / length[:, None]
    stated = np.array([seconds[t].get(SUMMARY, np.nan) for t in start_s], dtype=np.float64) / length
    any_tremor = np.where(np.isfinite(stated), stated, fractions[:, 2:].sum(axis=1))
    if (beyond := np.flatnonzero((np.nansum(fractions, axis=1) > 1 + SUM_TOLERANCE) | (any_tremor > 1 + SUM_TOLERANCE))).size:
        when = datetime.fromtimestamp(start_s[beyond[0]], UTC).isoformat()
        raise UndecodableFile(f"the minute of {when} holds more seconds than it has", "column duration", "Give the duration in seconds.")
    return _in_order(start_s, length, fractions, any_tremor, report)


def _class_seconds(seconds: dict[str, float], name: str) -> float:
    """Return the seconds of a class: no row for it means none, unless the minute states nothing but the sum and that is not 0."""
    if name in seconds:
        return seconds[name]
    only_sum = set(seconds) == {SUMMARY}
    return float("nan") if only_sum and (seconds[SUMMARY] > 0 or name in ("unknown", "none")) else 0.0


def _is_tremor_duration(row: list[str], columns: dict[str, int]) -> bool:
    kind = row[columns["stream_type_id"]].strip().lower() if "stream_type_id" in columns else "duration"
    measured = row[columns["measurement"]].strip().lower() if "measurement" in columns else "tremor"
    return kind == "duration" and measured == "tremor"


def _starts(table: TextTable, time: int, report: FileReport) -> NDArray[np.float64]:
    """Read Unix times of the rows, [n]; reports where a zone had to be assumed."""
    zoneless = 0
    out = np.empty(len(table.rows))
    zone = zone_of_header(table.headers[time])
    for i, (row, line) in enumerate(zip(table.rows, table.lines, strict=True)):
        out[i], assumed = _unix_s(row[time], line, zone)
        zoneless += assumed
    if zoneless:
        report.flagged.append(f"{zoneless} times without a zone were read as UTC: check that they are")
    return out


def _unix_s(cell: str, line: int, zone: tzinfo | None) -> tuple[float, bool]:
    """Parse the Unix time of a date, of a spreadsheet's day number, or of a number in s, ms, us or ns. Also return whether its zone
    was assumed.

    Args:
        cell: of the table. line: that it is in. zone: that the header states; it holds for dates without one.
    """
    where, hint = f"line {line}, column time", "Give the time as ISO 8601 with its zone, or as Unix time."
    try:
        value = parse_number(cell)
    except NotANumber:
        try:
            moment = named_month(cell) or datetime.fromisoformat(cell.strip())
            value, assumed = _in_utc(moment, zone)
        except ChangedClocks as error:
            what = "a time that the clocks of its zone show twice or never"
            raise UndecodableFile(f"{shown(cell)} is {what}", where, "Write the times with their offset from UTC.", what) from error
        except (ValueError, OverflowError) as error:
            raise UndecodableFile(f"{shown(cell)} is no time", where, hint, "a cell holds no time") from error
        if not EARLIEST_UNIX_S <= value < LATEST_UNIX_S:
            raise UndecodableFile("a time before any watch measured tremor", where, hint) from None
        return value, assumed
    if value is None or value <= 0:
        raise UndecodableFile("a minute has no time", where, hint)
    if (day := spreadsheet_date(value)) is not None:
        return _in_utc(day, zone)
    for unit in (1.0, 1e3, 1e6, 1e9):
        if EARLIEST_UNIX_S <= value / unit < LATEST_UNIX_S:
            return value / unit, False
    raise UndecodableFile(f"{value:g} is no date", where, hint, "a number that is no date")


def _in_utc(moment: datetime, zone: tzinfo | None) -> tuple[float, bool]:
    """Convert a moment to Unix time, s; True where it has no zone and none is stated, so that it counts as UTC."""
    if moment.tzinfo is None and zone is not None:
        moment = in_zone(moment, zone)
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp(), moment.tzinfo is None


def _in_order(
    start: NDArray[np.float64],
    length: NDArray[np.float64],
    fractions: NDArray[np.float64],
    any_tremor: NDArray[np.float64],
    report: FileReport,
) -> TremorLog:
    order = np.argsort(start, kind="stable")
    start = start[order]
    if undivided := int((np.isnan(fractions[:, 3:]).any(axis=1)).sum()):
        report.flagged.append(f"{undivided} minutes tell only all tremor together: mild, moderate and strong are not known")
    if overlaps := int(np.sum(np.diff(start) < length[order][:-1] - 1e-6)):
        begin = "minute begins" if overlaps == 1 else "minutes begin"
        report.flagged.append(
            f"{overlaps} {begin} before the one before has ended: times may have been rounded by a spreadsheet, or written without "
            "their zone in the night in which the clocks were changed"
        )
    return TremorLog(start, length[order], fractions[order], any_tremor[order])


def _lines(logs: Sequence[TremorLog]) -> list[str]:
    """Write a wide export with the length of each minute and all tremor together; times in Unix seconds."""
    lines = [",".join(("time", "duration_s", *TREMOR_CLASSES, "any_tremor"))]
    for log in logs:
        rows = zip(log.start_unix_s.tolist(), log.duration_s.tolist(), log.fractions.tolist(), log.any_tremor.tolist(), strict=True)
        lines += [",".join(map(cell, (start, length, *shares, any_))) for start, length, shares, any_ in rows]
    return lines


SHARE_ROLES = tuple(f"tremor_{name}" for name in TREMOR_CLASSES)
CLASS_ROLE = "tremor_class"


def _mapped_cells(
    table: TextTable, places: Mapping[str, int], t_s: NDArray[np.float64], absolute: bool
) -> tuple[list[str], list[list[str]]]:
    del absolute  # minutes find their session by the clock, so that their times always are
    if CLASS_ROLE in places:
        of_class = places[CLASS_ROLE]
        return ["time", "class"], [[cell(t), row[of_class].strip().lower()] for t, row in zip(t_s, table.rows, strict=True)]
    decimal = table.decimal_mark([places[role] for role in sorted(places, key=lambda role: places[role])])
    by_class = [table.numbers(places[role], decimal, role) if role in places else np.zeros(t_s.size) for role in SHARE_ROLES]
    return ["time", *TREMOR_CLASSES], [[cell(t), *map(cell, row)] for t, row in zip(t_s, np.column_stack(by_class), strict=True)]


WATCH_EXPORTS = OutcomeTable(
    kind="tremor",
    name="tremor export",
    holds=MEASURED,
    log=TremorLog,
    roles=(*SHARE_ROLES, CLASS_ROLE),
    recognises=looks_like_tremor,
    decode=decode_strivepd,
    lines=_lines,
    mapped_cells=_mapped_cells,
)
