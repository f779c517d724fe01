"""Minutes of tremor from StrivePD exports: wide (fractions per class) and long (seconds per severity). Source: format notes, A″."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.ingest.formats.delimited import TextTable, read_delimited
from app.ingest.formats.log import FileReport, UndecodableFile
from app.ingest.formats.numbers import NotANumber, column_name, parse_number, shown
from app.ingest.formats.options import DecodeOptions

CLASSES = ("unknown", "none", "slight", "mild", "moderate", "strong")
SUMMARY = "all"
"""slight + mild + moderate + strong of the same minute: no class of its own, never added to the others."""

MINUTE_S = 60.0
SUM_TOLERANCE = 0.02
IDENTITY = ("patient_id", "device_id")


@dataclass(frozen=True, slots=True, eq=False)
class TremorLog:
    """Minutes in time order.

    Attributes:
        start_unix_s: begin of each minute, shape [n].
        duration_s: length of each minute's measurement, shape [n].
        fractions: share per class in the order of `CLASSES`, shape [n, 6]; NaN where the export does not split the tremor.
        any_tremor: share with slight or worse tremor, shape [n]; NaN where not told.
    """

    start_unix_s: NDArray[np.float64]
    duration_s: NDArray[np.float64]
    fractions: NDArray[np.float64]
    any_tremor: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TremorFile:
    """The minutes of one file, and what became of it."""

    minutes: TremorLog
    report: FileReport


def decode_strivepd(path: Path, options: DecodeOptions | None = None, name: str | None = None) -> TremorFile:
    """Decode a wide or a long export, told apart by their columns.

    Raises:
        UndecodableFile: neither layout, text for a number, an unreadable time; names line and column.
    """
    table = read_delimited(path, (options or DecodeOptions()).max_table_rows, "time and one column per class")
    columns = {column_name(header)[0]: i for i, header in reversed(list(enumerate(table.headers)))}
    report = FileReport(name or path.name)
    report.repaired.extend(table.notes)
    report.removed.extend(f"column {key}" for key in IDENTITY if key in columns)
    if "time" not in columns:
        raise UndecodableFile("missing column time", "line 1", "Upload the export as StrivePD wrote it.")
    if set(CLASSES) <= set(columns):
        minutes = _wide(table, columns, report)
    elif {"severity", "duration"} <= set(columns):
        minutes = _long(table, columns, report)
    else:
        wanted = ", ".join(CLASSES)
        raise UndecodableFile(
            "neither layout of a tremor export",
            "line 1",
            f"A wide export has the columns time, {wanted}; a long one time, severity, duration.",
        )
    report.understood.append(f"{minutes.start_unix_s.size} minutes of tremor")
    return TremorFile(minutes, report)


def _wide(table: TextTable, columns: dict[str, int], report: FileReport) -> TremorLog:
    decimal = table.decimal_mark([columns[c] for c in CLASSES])
    start = np.array([_unix_s(row[columns["time"]], line) for row, line in zip(table.rows, table.lines, strict=True)], dtype=np.float64)
    fractions = np.column_stack([table.numbers(columns[c], decimal) for c in CLASSES]) if table.rows else np.empty((0, 6))
    outside = np.flatnonzero(((fractions < 0) | (fractions > 1)).any(axis=1))
    if outside.size:
        raise UndecodableFile("a fraction outside 0 to 1", f"line {table.lines[outside[0]]}", "Upload the export as StrivePD wrote it.")
    off = np.abs(fractions.sum(axis=1) - 1.0) > SUM_TOLERANCE
    if count := int(off.sum()):
        report.flagged.append(f"{count} minutes whose fractions do not add up to 1: kept as they are")
    return _in_order(start, np.full(start.size, MINUTE_S), fractions, fractions[:, 2:].sum(axis=1), report)


def _long(table: TextTable, columns: dict[str, int], report: FileReport) -> TremorLog:
    """Rows of seconds per severity, gathered by minute; rows of percentages say the same again and are left out."""
    seconds: dict[float, dict[str, float]] = defaultdict(dict)
    lengths: dict[float, float] = {}
    durations = table.numbers(columns["duration"], table.decimal_mark([columns["duration"]]))
    length_ns = table.numbers(columns["measurement_duration_ns"], ".") if "measurement_duration_ns" in columns else None
    skipped = 0
    for i, (row, line) in enumerate(zip(table.rows, table.lines, strict=True)):
        severity = row[columns["severity"]].strip().lower()
        if severity not in (*CLASSES, SUMMARY) or not _is_tremor_duration(row, columns) or not durations[i] >= 0:
            skipped += 1
            continue
        start = _unix_s(row[columns["time"]], line)
        seconds[start][severity] = float(durations[i])
        lengths[start] = MINUTE_S if length_ns is None or not length_ns[i] > 0 else float(length_ns[i]) / 1e9
    if skipped:
        report.ignored.append(f"{skipped} rows that are no seconds of tremor")
    start_s = np.array(sorted(seconds), dtype=np.float64)
    length = np.array([lengths[t] for t in start_s], dtype=np.float64)
    table_s = [[_class_seconds(seconds[t], c) for c in CLASSES] for t in start_s]
    fractions = np.array(table_s, dtype=np.float64).reshape(-1, 6) / length[:, None]
    told = np.array([seconds[t].get(SUMMARY, np.nan) for t in start_s], dtype=np.float64) / length
    any_tremor = np.where(np.isfinite(told), told, fractions[:, 2:].sum(axis=1))
    if undivided := int(np.isnan(fractions[:, 2:]).any(axis=1).sum()):
        report.flagged.append(f"{undivided} minutes tell only all tremor together: mild, moderate and strong are not known")
    return _in_order(start_s, length, fractions, any_tremor, report)


def _class_seconds(told: dict[str, float], name: str) -> float:
    """Seconds of a class: no row for it means none, unless the minute tells nothing but the sum and that is not 0."""
    if name in told:
        return told[name]
    only_sum = set(told) == {SUMMARY}
    return float("nan") if only_sum and (told[SUMMARY] > 0 or name in ("unknown", "none")) else 0.0


def _is_tremor_duration(row: list[str], columns: dict[str, int]) -> bool:
    kind = row[columns["stream_type_id"]].strip().lower() if "stream_type_id" in columns else "duration"
    measured = row[columns["measurement"]].strip().lower() if "measurement" in columns else "tremor"
    return kind == "duration" and measured == "tremor"


def _unix_s(cell: str, line: int) -> float:
    """Unix time of an ISO date, or of a number in s, ms, us or ns."""
    where, mend = f"line {line}, column time", "Give the time as ISO 8601 with its zone, or as Unix time."
    try:
        value = parse_number(cell)
    except NotANumber:
        try:
            moment = datetime.fromisoformat(cell.strip())
        except ValueError as error:
            raise UndecodableFile(f"{shown(cell)} is no time", where, mend) from error
        return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp()
    if value is None or value <= 0:
        raise UndecodableFile("a minute has no time", where, mend)
    while value > 1e11:
        value /= 1000.0
    return value


def _in_order(
    start: NDArray[np.float64],
    length: NDArray[np.float64],
    fractions: NDArray[np.float64],
    any_tremor: NDArray[np.float64],
    report: FileReport,
) -> TremorLog:
    order = np.argsort(start, kind="stable")
    start = start[order]
    if overlaps := int(np.sum(np.diff(start) < length[order][:-1] - 1e-6)):
        report.flagged.append(
            f"{overlaps} minutes begin before the one before has ended: their times may have been rounded by a spreadsheet"
        )
    return TremorLog(start, length[order], fractions[order], any_tremor[order])
