"""Tables of 2 s steps: CSV or Parquet with `t_s`, `beta` and an amplitude.

The row `t_s` covers (t_s - period, t_s]; rows with t_s <= 0 are the window before the session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.ingest.formats.delimited import read_delimited
from app.ingest.formats.log import DecodedFile, FileReport, RecordingLog, TraceLog, UndecodableFile, fingerprint
from app.ingest.formats.numbers import column_name, shown
from app.ingest.formats.options import DecodeOptions

GRID_TOLERANCE = 0.01
"""A time may lie this share of the period off the grid: clocks written with two decimals."""

TIME_NAMES = ("t_s", "t", "time_s", "time", "seconds", "t_sec")
BETA_NAMES = ("beta", "p_beta", "beta_amplitude", "beta_power")
FRACTION_NAMES = ("amplitude_fraction", "fraction", "amp_fraction", "stim_fraction", "a")
MILLIAMP_NAMES = ("amplitude_ma", "amp_ma", "stim_ma", "ma", "milliamps", "amplitude_milliamps")
TIME_SCALE = {None: 1.0, "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3}
NEEDED = "t_s, beta and amplitude_fraction (or amplitude_ma)"


@dataclass(slots=True)
class Columns:
    """Columns found, as they are called in the file, and their cells as float64 [n] with NaN for missing."""

    names: dict[str, str]
    units: dict[str, str | None]
    lines: NDArray[np.int64]
    values: dict[str, NDArray[np.float64]]
    ignored: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def decode_csv(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a text table. Raises UndecodableFile naming line and column."""
    return _decode(read_csv(path, options), options, name or path.name)


def decode_parquet(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a Parquet table. Raises UndecodableFile naming row and column."""
    return _decode(read_parquet(path, options), options, name or path.name)


def match_columns(headers: Sequence[str]) -> tuple[dict[str, int], dict[str, str | None], list[str]]:
    """Which header is which: role -> index, role -> unit, and the headers of no use.

    Raises:
        UndecodableFile: a needed column is missing or named twice.
    """
    found: dict[str, int] = {}
    units: dict[str, str | None] = {}
    unused: list[str] = []
    for index, header in enumerate(headers):
        key, unit = column_name(header)
        role = _role(key, unit)
        if role is None:
            unused.append(header.strip())
            continue
        if role in found:
            raise UndecodableFile(
                f"two columns both give {role}: {shown(headers[found[role]])} and {shown(header)}", "line 1", "Keep one of them."
            )
        found[role], units[role] = index, unit
    missing = [role for role in ("t_s", "beta") if role not in found]
    if "amplitude_fraction" not in found and "amplitude_ma" not in found:
        missing.append("amplitude_fraction (or amplitude_ma)")
    if missing:
        names = ", ".join(shown(h.strip()) for h in headers[:20]) or "none"
        raise UndecodableFile(f"missing column {', '.join(missing)}; found: {names}", "line 1", f"Name the columns {NEEDED}.")
    return found, units, unused


def _role(key: str, unit: str | None) -> str | None:
    if key in TIME_NAMES:
        return "t_s"
    if key in BETA_NAMES:
        return "beta"
    if key in MILLIAMP_NAMES or (key in ("amplitude", "amp", "stimulation") and unit is not None and unit.lower() == "ma"):
        return "amplitude_ma"
    return "amplitude_fraction" if key in FRACTION_NAMES else None


def read_csv(path: Path, options: DecodeOptions) -> Columns:
    """Cells of a text table; see `decode_csv`."""
    table = read_delimited(path, options.max_table_rows, NEEDED)
    found, units, unused = match_columns(table.headers)
    decimal = table.decimal_mark(list(found.values()))
    if decimal == ",":
        table.notes.append("decimal comma read as decimal point")
    values = {role: table.numbers(index, decimal) for role, index in found.items()}
    names = {role: table.headers[index].strip() for role, index in found.items()}
    return Columns(names, units, np.array(table.lines, dtype=np.int64), values, unused, table.notes)


def read_parquet(path: Path, options: DecodeOptions) -> Columns:
    """Columns of a Parquet table; see `decode_parquet`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    mend = "Write the table again, for example with pandas' to_parquet."
    try:
        file = pq.ParquetFile(path)
        headers = [str(n) for n in file.schema_arrow.names]
    except (pa.ArrowException, OSError, ValueError) as error:
        raise UndecodableFile("the Parquet file is damaged or cut", "file", mend) from error
    if file.metadata.num_rows > options.max_table_rows:
        raise UndecodableFile(f"more than {options.max_table_rows} rows", "file", "Upload one session per table.")
    found, units, unused = match_columns(headers)
    schema = file.schema_arrow
    for role, index in found.items():
        kind, meta = schema.field(index).type, schema.field(index).metadata or {}
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind) or pa.types.is_null(kind)):
            raise UndecodableFile(f"the column holds {kind}, not numbers", f"column {headers[index]}", "Store it as float64.")
        if units[role] is None and b"unit" in meta:
            units[role] = meta[b"unit"].decode("utf-8", "replace")
    try:
        table = file.read(columns=[headers[i] for i in found.values()])
        values = {role: _arrow_floats(table.column(headers[i])) for role, i in found.items()}
    except (pa.ArrowException, OSError, ValueError) as error:
        raise UndecodableFile("the Parquet file is damaged or cut", "file", mend) from error
    lines = np.arange(1, table.num_rows + 1, dtype=np.int64)
    return Columns({role: headers[i] for role, i in found.items()}, units, lines, values, unused, [])


def _arrow_floats(column: object) -> NDArray[np.float64]:
    import pyarrow as pa

    floats = column.cast(pa.float64()).to_numpy()  # type: ignore[attr-defined]
    floats = np.array(floats, dtype=np.float64)
    floats[~np.isfinite(floats)] = np.nan
    return floats


def _decode(columns: Columns, options: DecodeOptions, name: str) -> DecodedFile:
    report = FileReport(name)
    report.repaired.extend(columns.notes)
    if columns.ignored:
        report.ignored.append(f"columns of no use here: {', '.join(shown(c) for c in columns.ignored[:20])}")
    t_s = _times(columns, options)
    row, t_first = _grid(t_s, columns, options)
    n = int(row[-1]) + 1
    traces = tuple(_trace(role, columns, row, n, t_first, options, report) for role in columns.values if role != "t_s")
    _describe(report, row, n, t_first, options)
    return DecodedFile((_recording(traces, t_first, n, options),), (report,))


def _times(columns: Columns, options: DecodeOptions) -> NDArray[np.float64]:
    """t_s in seconds, checked to be there, to increase and to reach beyond 0."""
    header = columns.names["t_s"]
    unit = columns.units["t_s"]
    scale = TIME_SCALE.get(unit.lower() if unit else None)
    if scale is None:
        raise UndecodableFile(f"unknown unit {shown(unit or '')} of the time column", f"column {header}", "Give the time in seconds (s).")
    t_s = columns.values["t_s"] * scale
    if t_s.size == 0:
        raise UndecodableFile("the table has a header but no rows", "after line 1", "Add one row per step.")
    empty = np.flatnonzero(np.isnan(t_s))
    if empty.size:
        raise UndecodableFile("a row has no time", f"line {columns.lines[empty[0]]}, column {header}", "Give every row its t_s.")
    back = np.flatnonzero(np.diff(t_s) <= 0)
    if back.size:
        i = int(back[0]) + 1
        what = "appears twice" if t_s[i] == t_s[i - 1] else f"comes after {t_s[i - 1]:g} s"
        raise UndecodableFile(
            f"times must increase: {t_s[i]:g} s {what}",
            f"line {columns.lines[i]}, column {header}",
            "Sort the rows by t_s; keep one row per time.",
        )
    if not np.any(t_s > GRID_TOLERANCE * options.period_s):
        raise UndecodableFile(
            "no row with t_s > 0", f"column {header}", "Rows with t_s <= 0 are the window before the session; add the session."
        )
    return t_s


def _grid(t_s: NDArray[np.float64], columns: Columns, options: DecodeOptions) -> tuple[NDArray[np.int64], float]:
    """Row of the common grid for each line, and the end of the first row; raises where the spacing is another."""
    period = options.period_s
    header = columns.names["t_s"]
    steps = np.rint(t_s / period)
    if steps[-1] - steps[0] >= options.max_table_rows:
        raise UndecodableFile(
            f"the times span {t_s[-1] - t_s[0]:g} s, more than {options.max_table_rows} steps",
            f"column {header}",
            "Upload one session per table.",
        )
    spacing = np.diff(t_s)
    uneven = np.flatnonzero((np.abs(spacing - period * np.rint(spacing / period)) > GRID_TOLERANCE * period) | (spacing < period / 2))
    if uneven.size:
        i = int(uneven[0])
        raise UndecodableFile(
            f"{spacing[i]:g} s between two rows where the period is {period:g} s",
            f"line {columns.lines[i + 1]}, column {header}",
            f"Write one row every {period:g} s, or set the participant's period.",
        )
    off = np.flatnonzero(np.abs(t_s - steps * period) > GRID_TOLERANCE * period)
    if off.size:
        i = int(off[0])
        raise UndecodableFile(
            f"{t_s[i]:g} s is no multiple of the period {period:g} s",
            f"line {columns.lines[i]}, column {header}",
            f"The row t_s covers the {period:g} s that end at t_s and the session starts at 0: use {period:g}, {2 * period:g}, …",
        )
    return (steps - steps[0]).astype(np.int64), float(steps[0] * period)


def _trace(
    role: str, columns: Columns, row: NDArray[np.int64], n: int, t_first: float, options: DecodeOptions, report: FileReport
) -> TraceLog:
    given = columns.values[role]
    header = columns.names[role]
    unit = columns.units[role]
    if role != "beta" and np.any(given < 0):
        i = int(np.flatnonzero(given < 0)[0])
        raise UndecodableFile(
            f"negative amplitude {given[i]:g}",
            f"line {columns.lines[i]}, column {header}",
            "Amplitudes are 0 or more; leave the cell empty if unknown.",
        )
    if role == "amplitude_fraction" and (above := int(np.sum(given > 1))):
        report.flagged.append(f"{above} rows have an amplitude above the cDBS amplitude (fraction > 1); kept as they are")
    values = np.full(n, np.nan, dtype=np.float32)
    with np.errstate(over="ignore"):
        values[row] = given.astype(np.float32)
    values[~np.isfinite(values)] = np.nan
    valid = np.isfinite(values)
    if lost := int(row.size - np.sum(valid[row])):
        report.flagged.append(f"{lost} rows without a number in {header}: kept as gaps")
    if role == "beta":
        stated = unit or options.table_beta_unit
        return TraceLog("beta", "table", stated, "table", options.period_s, t_first, values, valid, {"column": header})
    stream_unit = "mA" if role == "amplitude_ma" else "fraction"
    return TraceLog("amplitude", role, stream_unit, "table", options.period_s, t_first, values, valid, {"column": header})


def _describe(report: FileReport, row: NDArray[np.int64], n: int, t_first: float, options: DecodeOptions) -> None:
    before = int(np.sum(t_first + row * options.period_s <= GRID_TOLERANCE))
    report.understood.append(f"{row.size} rows of {options.period_s:g} s: {before} before the session, {row.size - before} of the session")
    if n > row.size:
        report.repaired.append(f"{n - row.size} missing rows filled in as gaps")


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
