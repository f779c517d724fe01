"""Tables of 2 s steps: CSV or Parquet with `t_s`, `beta` and an amplitude; tables of raw LFP are passed on to `table_lfp`.

The row `t_s` covers (t_s - period, t_s]; rows with t_s <= 0 are the window before the session.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.disagreements import CONFLICTS, disagreements_of_rows
from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, FileReport, RecordingLog, TraceLog, UndecodableFile, fingerprint
from ml.formats.tables.amplitudes import checked_amplitude, compare_amplitudes
from ml.formats.tables.cells.fills import without_fills
from ml.formats.tables.cells.numbers import shown, unit_name
from ml.formats.tables.columns import (
    TIME_SCALE,
    Columns,
    check_reach,
    read_csv,
    read_parquet,
)
from ml.formats.tables.lfp import decode_lfp

GRID_TOLERANCE = 0.01
"""A time may lie this share of the period off the grid: clocks written with two decimals."""

LEAST_SHARE = 0.1
FEWEST_ROWS = 3
"""A table of so many rows that has fewer than this share of its steps is of another unit or period."""

LARGEST_BETA = 1e9
"""No amplifier gives such a beta in any unit: an error of the writer, such as a fill value."""


def decode_csv(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a text table. Raises UndecodableFile naming line and column."""
    return decode_columns(read_csv(path, options), options, name or path.name)


def decode_parquet(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a Parquet table. Raises UndecodableFile naming row and column."""
    return decode_columns(read_parquet(path, options), options, name or path.name)


def decode_columns(columns: Columns, options: DecodeOptions, name: str) -> DecodedFile:
    """Decode a recording from the columns. Raises UndecodableFile naming line and column."""
    report = FileReport(name)
    report.repaired.extend(columns.notes)
    if columns.ignored:
        report.ignored.append(f"columns of no use here: {', '.join(shown(c) for c in columns.ignored[:20])}")
    if "lfp" in columns.values:
        return decode_lfp(columns, options, report)
    t_s = _times(columns, options)
    row, t_first = _grid(t_s, columns, options)
    n = int(row[-1]) + 1
    given = {role: _check_column(role, columns, report) for role in columns.values if role != "t_s"}
    conflicts: list[dict[str, Any]] = []
    if "amplitude_ma" in given and "amplitude_fraction" in given:
        differ = np.zeros(n, dtype=bool)
        differ[row] = compare_amplitudes(given["amplitude_ma"], given.pop("amplitude_fraction"), report)
        stated = np.full(n, np.nan)
        stated[row] = given["amplitude_ma"]
        begin = t_first - options.period_s
        conflicts = disagreements_of_rows(differ, {"amplitude_ma": stated}, "amplitude_ma", begin, options.period_s)
        given["amplitude_ma"] = np.where(differ[row], np.nan, given["amplitude_ma"])
    traces = tuple(_trace(role, values, columns, row, n, t_first, options) for role, values in given.items())
    _describe(report, row, n, t_first, options)
    recording = _recording(traces, t_first, n, options)
    return DecodedFile((replace(recording, quality={**recording.quality, CONFLICTS: conflicts}) if conflicts else recording,), (report,))


def _times(columns: Columns, options: DecodeOptions) -> NDArray[np.float64]:
    """Read t_s in seconds, checked to be there, to increase and to reach beyond 0."""
    t_s = columns.values["t_s"] * TIME_SCALE[columns.units["t_s"]]
    if t_s.size == 0:
        raise UndecodableFile("the table has a header but no rows", "after line 1", "Add one row per step.")
    empty = np.flatnonzero(np.isnan(t_s))
    if empty.size:
        raise columns.error("a row has no time", "t_s", "Give every row its t_s.", int(empty[0]))
    back = np.flatnonzero(np.diff(t_s) <= 0)
    if back.size:
        i = int(back[0]) + 1
        what = "appears twice" if t_s[i] == t_s[i - 1] else f"comes after {t_s[i - 1]:g} s"
        hint = "Sort the rows by t_s; keep one row per time. A table of several sessions needs a column session."
        raise columns.error(f"times must increase: {t_s[i]:g} s {what}", "t_s", hint, i)
    check_reach(t_s, columns)
    if not np.any(t_s > GRID_TOLERANCE * options.period_s):
        raise columns.error("no row with t_s > 0", "t_s", "Rows with t_s <= 0 are the window before the session; add the session.")
    return t_s


def _grid(t_s: NDArray[np.float64], columns: Columns, options: DecodeOptions) -> tuple[NDArray[np.int64], float]:
    """Find the row of the common grid for each line, and the end of the first row; raises where the spacing is another."""
    period = options.period_s
    steps = np.rint(t_s / period)
    if steps[-1] - steps[0] >= options.max_table_rows:
        what = f"the times span {t_s[-1] - t_s[0]:g} s, more than {options.max_table_rows} steps"
        raise columns.error(what, "t_s", "Upload one session per table.")
    spacing = np.diff(t_s)
    uneven = np.flatnonzero((np.abs(spacing - period * np.rint(spacing / period)) > GRID_TOLERANCE * period) | (spacing < period / 2))
    if uneven.size:
        i = int(uneven[0])
        what = f"{spacing[i]:g} s between two rows where the period is {period:g} s"
        raise columns.error(what, "t_s", f"Write one row every {period:g} s, or set the participant's period.", i + 1)
    if t_s.size >= FEWEST_ROWS and t_s.size < LEAST_SHARE * (steps[-1] - steps[0] + 1):
        share = 100.0 * (1.0 - t_s.size / (steps[-1] - steps[0] + 1))
        what = f"{share:.1f} % of the steps of {period:g} s have no row: rows follow each other after {np.median(spacing):g} s"
        hint = f"Write one row every {period:g} s. If the times are milliseconds, name the column t_ms; else set the participant's period."
        raise columns.error(what, "t_s", hint, 1)
    off = np.flatnonzero(np.abs(t_s - steps * period) > GRID_TOLERANCE * period)
    if off.size:
        i = int(off[0])
        hint = f"The row t_s covers the {period:g} s that end at t_s and the session starts at 0: use {period:g}, {2 * period:g}, …"
        raise columns.error(f"{t_s[i]:g} s is no multiple of the period {period:g} s", "t_s", hint, i)
    return (steps - steps[0]).astype(np.int64), float(steps[0] * period)


def _check_column(role: str, columns: Columns, report: FileReport) -> NDArray[np.float64]:
    """Check a column's numbers [rows] in mA, as a fraction, or beta as it is; NaN where there is none or it cannot be true."""
    if role != "beta":
        return checked_amplitude(role, columns, report)
    values = columns.values[role]
    if lost := int(np.sum(np.isnan(values))):
        report.flagged.append(f"{lost} rows without a number in {role}: kept as gaps")
    return _checked_beta(without_fills(role, values, columns.lines, report), columns.lines, report)


def _checked_beta(values: NDArray[np.float64], lines: NDArray[np.int64], report: FileReport) -> NDArray[np.float64]:
    absurd = np.flatnonzero(np.abs(values) > LARGEST_BETA)
    if absurd.size:
        where = ", ".join(str(line) for line in lines[absurd[:5]]) + (", …" if absurd.size > 5 else "")
        report.flagged.append(f"{absurd.size} rows with a beta beyond {LARGEST_BETA:g} in magnitude (line {where}): kept as gaps")
        values = values.copy()
        values[absurd] = np.nan
    if negative := int(np.sum(values < 0)):
        report.flagged.append(
            f"{negative} rows have a negative beta, which no amplitude or power is (a logarithm or z-score may be); kept as they are"
        )
    return values


def _trace(
    role: str, given: NDArray[np.float64], columns: Columns, row: NDArray[np.int64], n: int, t_first: float, options: DecodeOptions
) -> TraceLog:
    values = np.full(n, np.nan, dtype=np.float32)
    values[row] = given.astype(np.float32)
    valid = np.isfinite(values)
    unit = columns.units[role]
    details = {"column": columns.label(role)}
    if role == "beta":
        stated = unit_name(unit or options.table_beta_unit)
        details["unit_from"] = "header" if unit else "options"
        return TraceLog("beta", "table", stated, "table", options.period_s, t_first, values, valid, details)
    stream_unit = "mA" if role == "amplitude_ma" else "fraction"
    return TraceLog("amplitude", role, stream_unit, "table", options.period_s, t_first, values, valid, details)


def _describe(report: FileReport, row: NDArray[np.int64], n: int, t_first: float, options: DecodeOptions) -> None:
    before = int(np.sum(t_first + row * options.period_s <= GRID_TOLERANCE))
    report.understood.append(f"{row.size} rows of {options.period_s:g} s: {before} before the session, {row.size - before} of the session")
    if n > row.size:
        lost = n - row.size
        report.flagged.append(f"{lost} row{'s' if lost > 1 else ''} missing: gaps")


def _recording(traces: tuple[TraceLog, ...], t_first: float, n: int, options: DecodeOptions) -> RecordingLog:
    t_last = t_first + (n - 1) * options.period_s
    quality = {f"{t.stream}.{t.channel}": {"valid_fraction": round(float(t.valid.mean()), 6)} for t in traces}
    parts: list[str | bytes | NDArray[np.float32]] = [f"{t_first:.6f}", f"{options.period_s:.6f}"]
    for trace in sorted(traces, key=lambda t: (t.stream, t.channel)):
        parts += [trace.stream, trace.channel, trace.unit, trace.values]
    return RecordingLog(
        kind="table",
        device_key=None,
        hemisphere=None,
        clock="table",
        started_at=None,
        duration_s=float(t_last),
        traces=traces,
        events=(),
        limits={},
        settings={"period_s": options.period_s},
        quality=quality,
        fingerprint=fingerprint("table", parts),
    )
