"""Tables of 2 s steps: CSV or Parquet with `t_s`, `beta` and an amplitude.

The row `t_s` covers (t_s - period, t_s]; rows with t_s <= 0 are the window before the session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.ingest.formats.delimited import read_delimited
from app.ingest.formats.log import DecodedFile, FileReport, RecordingLog, TraceLog, UndecodableFile, fingerprint
from app.ingest.formats.numbers import column_name, known_unit, shown, unit_name
from app.ingest.formats.options import DecodeOptions

GRID_TOLERANCE = 0.01
"""A time may lie this share of the period off the grid: clocks written with two decimals."""

TIME_NAMES = ("t_s", "t", "time_s", "time", "seconds", "t_sec")
BETA_NAMES = ("beta", "p_beta", "beta_amplitude", "beta_power")
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
LARGEST = {"amplitude_ma": 25.5, "amplitude_fraction": 10.0}
"""25.5 mA is the largest amplitude that a stimulator like RC+S or Percept can be set to; a fraction above 10 was meant as percent."""
LARGEST_BETA = 1e9
"""No amplifier gives such a beta in any unit: an error of the writer, such as a fill value."""
RATIO_SPREAD = 0.05
"""mA per fraction may vary by this share, for rounded cells, and still be one cDBS amplitude."""
LEAST_FRACTION = 0.05
"""Below this fraction rounding alone moves the ratio."""
NEEDED = "t_s, beta and amplitude_fraction (or amplitude_ma)"


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
        """The column as a stored file or report may call it: its role and the unit in brackets."""
        unit = self.units[role]
        return f"{role} [{unit}]" if unit else role

    def error(self, what: str, role: str, mend: str, row: int | None = None, stored: str | None = None) -> UndecodableFile:
        """An error at a column, and at the line of a row; `stored` is the text without the file's own words."""
        line = "" if row is None else f"line {self.lines[row]}, "
        return UndecodableFile(what, f"{line}column {self.names[role]}", mend, stored, f"{line}column {role}")


def decode_csv(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a text table. Raises UndecodableFile naming line and column."""
    return decode_columns(read_csv(path, options), options, name or path.name)


def decode_parquet(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a Parquet table. Raises UndecodableFile naming row and column."""
    return decode_columns(read_parquet(path, options), options, name or path.name)


def match_columns(headers: Sequence[str]) -> tuple[dict[str, int], dict[str, str | None], list[str], list[str]]:
    """Which header is which: role -> index, role -> unit, the headers of no use, and sentences about what was adapted.

    Raises:
        UndecodableFile: a needed column is missing, named twice or in an unknown unit.
    """
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


def _check_complete(found: dict[str, int], headers: Sequence[str]) -> None:
    """Raise where a needed column is missing, naming its unit as the reason where that is all that is wrong."""
    missing = [role for role in ("t_s", "beta") if role not in found]
    if "amplitude_fraction" not in found and "amplitude_ma" not in found:
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
    if key in TIME_NAMES:
        return "t_s"
    if key in BETA_NAMES:
        return "beta"
    if key in MILLIAMP_NAMES:
        return "amplitude_ma"
    if key in FRACTION_NAMES:
        return "amplitude_fraction"
    if key in AMPLITUDE_NAMES and unit is not None:
        return next((role for role, known in PER_UNIT.items() if unit_name(unit) in known), None)
    return None


def _header_unit(role: str, unit: str | None, header: str, notes: list[str]) -> str | None:
    """The unit of a column in its one spelling. Raises UndecodableFile for a unit that its numbers cannot be converted from."""
    if unit is None:
        return None
    if role == "t_s":
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
    mend = {
        "t_s": "Give the time in seconds (s).",
        "amplitude_ma": "Give the amplitude in mA, and say so in the header: amplitude (mA). uA and A are converted.",
        "amplitude_fraction": "Give the fraction of the cDBS amplitude, 0 to 1, or percent with the header amplitude_fraction (%).",
    }[role]
    column = "time" if role == "t_s" else "amplitude"
    what = f"unknown unit {shown(unit)} of the {column} column"
    return UndecodableFile(what, f"column {header.strip()}", mend, f"unknown unit of the {column} column", f"column {role}")


def read_csv(path: Path, options: DecodeOptions) -> Columns:
    """Cells of a text table; see `decode_csv`."""
    table = read_delimited(path, options.max_table_rows, NEEDED)
    found, units, unused, notes = match_columns(table.headers)
    table.notes.extend(notes)
    decimal = table.decimal_mark(list(found.values()))
    if decimal == ",":
        table.notes.append("decimal comma read as decimal point")
    values = {role: table.numbers(index, decimal, role) for role, index in found.items()}
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
        raise UndecodableFile("the Parquet file is damaged or cut", "file", mend) from error
    lines = np.arange(1, table.num_rows + 1, dtype=np.int64)
    return Columns({role: headers[i] for role, i in found.items()}, units, lines, values, unused, notes)


def _with_unit(column: Any) -> str:
    """A Parquet column's header, with the unit of its metadata in brackets where the header itself states none."""
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


def decode_columns(columns: Columns, options: DecodeOptions, name: str) -> DecodedFile:
    """A recording out of the columns. Raises UndecodableFile naming line and column."""
    report = FileReport(name)
    report.repaired.extend(columns.notes)
    if columns.ignored:
        report.ignored.append(f"columns of no use here: {', '.join(shown(c) for c in columns.ignored[:20])}")
    t_s = _times(columns, options)
    row, t_first = _grid(t_s, columns, options)
    n = int(row[-1]) + 1
    given = {role: _checked(role, columns, report) for role in columns.values if role != "t_s"}
    if "amplitude_ma" in given and "amplitude_fraction" in given:
        _compare(given["amplitude_ma"], given.pop("amplitude_fraction"), report)
    traces = tuple(_trace(role, values, columns, row, n, t_first, options) for role, values in given.items())
    _describe(report, row, n, t_first, options)
    return DecodedFile((_recording(traces, t_first, n, options),), (report,))


def _times(columns: Columns, options: DecodeOptions) -> NDArray[np.float64]:
    """t_s in seconds, checked to be there, to increase and to reach beyond 0."""
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
        raise columns.error(f"times must increase: {t_s[i]:g} s {what}", "t_s", "Sort the rows by t_s; keep one row per time.", i)
    if not np.any(t_s > GRID_TOLERANCE * options.period_s):
        raise columns.error("no row with t_s > 0", "t_s", "Rows with t_s <= 0 are the window before the session; add the session.")
    return t_s


def _grid(t_s: NDArray[np.float64], columns: Columns, options: DecodeOptions) -> tuple[NDArray[np.int64], float]:
    """Row of the common grid for each line, and the end of the first row; raises where the spacing is another."""
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
    off = np.flatnonzero(np.abs(t_s - steps * period) > GRID_TOLERANCE * period)
    if off.size:
        i = int(off[0])
        mend = f"The row t_s covers the {period:g} s that end at t_s and the session starts at 0: use {period:g}, {2 * period:g}, …"
        raise columns.error(f"{t_s[i]:g} s is no multiple of the period {period:g} s", "t_s", mend, i)
    return (steps - steps[0]).astype(np.int64), float(steps[0] * period)


def _checked(role: str, columns: Columns, report: FileReport) -> NDArray[np.float64]:
    """A column's numbers [rows] in mA, as a fraction, or beta as it is; NaN where there is none or it cannot be true."""
    values = columns.values[role]
    if lost := int(np.sum(np.isnan(values))):
        report.flagged.append(f"{lost} rows without a number in {role}: kept as gaps")
    if role == "beta":
        return _checked_beta(values, columns.lines, report)
    values = values / PER_UNIT[role][columns.units[role]]
    if (negative := np.flatnonzero(values < 0)).size:
        mend = "Amplitudes are 0 or more; leave the cell empty if unknown."
        raise columns.error(f"negative amplitude {values[negative[0]]:g}", role, mend, int(negative[0]))
    if (absurd := np.flatnonzero(values > LARGEST[role] * (1 + 1e-9))).size:
        raise _absurd(role, float(values[absurd[0]]), columns, int(absurd[0]))
    if role == "amplitude_fraction" and (above := int(np.sum(values > 1))):
        report.flagged.append(f"{above} rows have an amplitude above the cDBS amplitude (fraction > 1); kept as they are")
    return values


def _absurd(role: str, value: float, columns: Columns, row: int) -> UndecodableFile:
    largest = LARGEST[role]
    if role == "amplitude_ma":
        what = f"amplitude {value:g} mA, more than the {largest:g} mA that a stimulator can give"
        mend = "Give mA; if the numbers are in uA, name the column amplitude (uA)."
    else:
        what = f"amplitude fraction {value:g}, more than {largest:g} times the cDBS amplitude"
        mend = "Give 1 for the cDBS amplitude; name the column amplitude_fraction (%) for percent or amplitude_ma for mA."
    return columns.error(what, role, mend, row)


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


def _compare(milliamps: NDArray[np.float64], fraction: NDArray[np.float64], report: FileReport) -> None:
    """Say which of two amplitude columns is used, and whether both can be true for one cDBS amplitude."""
    report.ignored.append("amplitude_fraction: amplitude_ma is given too and is what is stored")
    both = np.isfinite(milliamps) & np.isfinite(fraction) & (fraction > LEAST_FRACTION)
    if not both.any():
        return
    ratio = milliamps[both] / fraction[both]
    if ratio.max() > (1 + RATIO_SPREAD) * ratio.min():
        runs = f"runs from {ratio.min():.3g} to {ratio.max():.3g} mA"
        report.flagged.append(f"amplitude_ma and amplitude_fraction disagree: their ratio, the cDBS amplitude, {runs}")


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
