"""The controller's own log, as `betaloop control --log` and the runner of a bundle write it.

A row has the beta amplitude of the period that ended at `due_s`. Its amplitude applies from `t_s` to the next row's. In a table of steps
both belong to two rows: here each beta has the amplitude that was in force while it was measured.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import numpy as np
from numpy.typing import NDArray

from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, TraceSource, UndecodableFile
from ml.formats.redaction_record import Redaction
from ml.formats.source import Source
from ml.formats.tables.cells.numbers import NotANumber, known_unit, parse_number, shown
from ml.formats.tables.columns import Columns
from ml.formats.tables.log_head import ENDS, MEND, Ran, read_head
from ml.formats.tables.masked import row_of
from ml.formats.tables.steps import GRID_TOLERANCE, decode_columns

MARK = b"# betaloop controller log"
NEEDED = ("t_s", "beta", "unit", "amplitude_ma")
OPTIONAL = ("due_s", "source", "reasons", "action", "hold", "log_density", "ended", "battery_percent", "sealed")
NO_BETA = frozenset({"no_beta", "invalid_beta", "wrong_signal", "late_sample"})
"""Reasons of a decision whose beta amplitude is not one of the period that ended."""
UNKNOWN_START = 0.05
"""A step's amplitude counts as known where the first decision came within this share of the period."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Log:
    """The rows of a log: decided at `t_s`, for the period that ended at `due_s`; beta (NaN: none) in `unit` from `source`; amplitude.

    `ran` is None for logs of version 1, which lack it. The rest is in logs from version 3 on. `followed`: whether policy or schedule was
    followed. `hold` and `log_density`: of the drawn amplitude (-1 and NaN: none). `battery_percent` of the tablet; `ended`.
    """

    ran: Ran | None
    head: str
    period_s: float
    lines: NDArray[np.int64]
    t_s: Floats
    due_s: Floats
    beta: Floats
    amplitude_ma: Floats
    unit: str
    source: str
    followed: NDArray[np.bool_]
    hold: NDArray[np.int64]
    log_density: Floats
    battery_percent: Floats
    ended: str | None

    @property
    def zero_s(self) -> float:
        """Start of the session on the log's clock, normally 0. With a device side connected, it is the first decision that followed policy
        or schedule; what comes before is the window before the session."""
        if self.ran is None or not self.ran.counts_from_take_over or not self.followed.any():
            return 0.0
        return float(self.due_s[int(np.argmax(self.followed))])


def is_log(path: Source) -> bool:
    """Decide whether the first line of a file names it a controller's log."""
    with path.open("rb") as stream:
        return stream.read(200).removeprefix(b"\xef\xbb\xbf").startswith(MARK)


def decode_log(path: Source, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a controller's log into beta and the amplitude in force, one row per period; the last decision has no period yet.

    Raises:
        UndecodableFile: another version or period, a column is missing, or a cell that is no number; names the line.
    """
    log = _read(path, options)
    columns = Columns(
        names={"t_s": "due_s", "beta": "beta", "amplitude_ma": "amplitude_ma"},
        units={"t_s": None, "beta": log.unit, "amplitude_ma": "mA"},
        lines=log.lines,
        values={"t_s": log.due_s - log.zero_s, "beta": log.beta, "amplitude_ma": in_force(log)},
    )
    decoded = decode_columns(columns, options, name or path.name)
    (recording,) = decoded.recordings
    source = cast(TraceSource, log.source) if log.source in get_args(TraceSource) else "table"
    traces = tuple(
        replace(t, source=source) if t.stream == "beta" else replace(t, source="device_log", details={**t.details, "origin": "controller"})
        for t in recording.traces
    )
    said = f"log of the controller: {log.lines.size} decisions, each put to the period that followed it"
    decoded.reports[0].understood.insert(0, said)
    if log.ran is None:
        return replace(decoded, recordings=(replace(recording, kind="controller_log", traces=traces),))
    settings = {**recording.settings, "controller": asdict(log.ran) | _of_rows(log)}
    made = replace(recording, kind="controller_log", hemisphere=log.ran.side, traces=traces, settings=settings)
    if log.ran.started_at is not None and log.ran.counts_from_take_over:
        made = replace(made, clock="pc", started_at=datetime.fromisoformat(log.ran.started_at) + timedelta(seconds=log.zero_s))
    return replace(decoded, recordings=(made,))


def _of_rows(log: Log) -> dict[str, Any]:
    """Summarise the rows of a log of version 3 for the whole session: its end, what was drawn and delivered, the tablet's battery.

    `policy_share` is the share of decisions that followed policy or schedule, from the take-over on.
    """
    known = np.flatnonzero(np.isfinite(log.battery_percent))
    charge = log.battery_percent[known[[0, -1]]].tolist() if known.size else None
    minutes = float(log.t_s[known[-1]] - log.t_s[known[0]]) / 60 if known.size else None
    decided = log.followed[(log.due_s >= log.zero_s) & (np.arange(log.due_s.size) < log.due_s.size - (log.ended is not None))]
    share = float(decided.mean()) if decided.size else 0.0
    return {
        "ended": log.ended,
        "policy_share": share,
        "holds": delivered_holds(log),
        "tablet_battery_percent": charge,
        "tablet_battery_minutes": minutes,
    }


def delivered_holds(log: Log) -> list[dict[str, Any]]:
    """List drawn amplitudes as they were delivered, `start`, `steps`, `amplitude` (fraction) and `log_density`, without gaps from step 0.

    A stretch on which cDBS replaced the schedule, or that is missing in the log, has no density. It cuts the hold that it interrupts. Empty
    where nothing was drawn or sustained.
    """
    if log.ran is None or log.ran.design is None or not log.followed.any():
        return []
    steps = np.rint((log.due_s[:-1] - log.zero_s) / log.period_s).astype(np.int64)
    rows = {int(k): i for i, k in enumerate(steps) if k >= 0}
    out: list[dict[str, Any]] = []
    before: int | None = None
    for k in range(int(steps[-1]) + 1 if steps.size else 0):
        i = rows.get(k)
        hold = -1 if i is None else int(log.hold[i])
        density = None if hold < 0 or i is None or np.isnan(log.log_density[i]) else float(log.log_density[i])
        amplitude = 1.0 if i is None else min(float(log.amplitude_ma[i]) / log.ran.cdbs_ma, 1.0)
        if out and hold == before:
            out[-1] |= {"steps": out[-1]["steps"] + 1, "amplitude": round(amplitude, 6)}  # a ramp may lead up to it
        else:
            out.append({"start": k, "steps": 1, "amplitude": round(amplitude, 6), "log_density": density})
        before = hold
    return out


def in_force(log: Log) -> Floats:
    """Average the amplitude in force over the period that ends at each row, mA, [n]; NaN before the first decision and where rows are
    missing."""
    t, period = log.t_s, log.period_s
    sums = np.concatenate([[0.0], np.cumsum(log.amplitude_ma[:-1] * np.diff(t))])

    def delivered(until: Floats) -> Floats:
        """Integrate the amplitude since the first decision, mA s."""
        j = np.maximum(np.searchsorted(t, until, side="right") - 1, 0)
        return np.asarray(sums[j] + log.amplitude_ma[j] * (until - t[j]), dtype=np.float64)

    begin = log.due_s - period
    mean = (delivered(log.due_s) - delivered(begin)) / period
    known = t[0] - begin <= UNKNOWN_START * period
    known &= np.concatenate([[False], np.diff(log.due_s) <= (1 + GRID_TOLERANCE) * period])
    return np.where(known, mean, np.nan)


def redact_log(source: Source, target: Path, options: DecodeOptions) -> Redaction:
    """Write a log of its numbers alone, which decodes to the same recording. Raises UndecodableFile as `decode_log`, before it writes."""
    log = _read(source, options)
    decode_log(source, options, "log")
    kept = log.source if log.source in get_args(TraceSource) else "table"
    last = log.lines.size - 1
    with target.open("w", encoding="utf-8", newline="") as out:
        out.write(f"{log.head}\nt_s,due_s,beta,unit,source,amplitude_ma,action,hold,log_density,ended,battery_percent\n")
        for i in range(log.lines.size):
            cells: list[Any] = [log.t_s[i], log.due_s[i], log.beta[i], log.unit, kept, log.amplitude_ma[i]]
            cells += ["policy" if log.followed[i] else "cdbs", "" if log.hold[i] < 0 else int(log.hold[i]), log.log_density[i]]
            cells += [log.ended or "" if i == last else "", log.battery_percent[i]]
            out.write(",".join(_cell(cell) for cell in cells) + "\n")
    return Redaction(removed=["what the controller noted beside beta and amplitude"])


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if np.isnan(value) else repr(float(value))
    return str(value)


@contextmanager
def _open_lines(path: Source) -> Iterator[Iterator[str]]:
    with path.open("rb") as raw, io.TextIOWrapper(raw, encoding="utf-8-sig", errors="replace", newline="") as stream:
        yield iter(stream)


def _read(path: Source, options: DecodeOptions) -> Log:
    with _open_lines(path) as lines:
        period_s, ran, head, nonce = read_head(lines, options)
        before = head.count("\n") + 1
        reader = csv.reader(lines)
        headers = [h.strip() for h in next(reader, [])]
        missing = [name for name in NEEDED if name not in headers]
        if missing:
            what = f"a controller's log without the column{'s' if len(missing) > 1 else ''} {', '.join(missing)}"
            raise UndecodableFile(what, f"line {before + 1}", MEND)
        at = {name: headers.index(name) for name in (*NEEDED, *OPTIONAL) if name in headers}
        found: list[_Cells] = []
        for row in reader:
            line = reader.line_num + before
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(headers):
                raise UndecodableFile(f"{len(row)} cells where the header has {len(headers)}", f"line {line}", MEND)
            if len(found) >= options.max_table_rows:
                raise UndecodableFile(f"more than {options.max_table_rows} rows", f"line {line}", "Upload one session per log.")
            found.append(_row(row, at, line, nonce))
    if not found:
        raise UndecodableFile("the log has no decision", f"after line {before + 1}", "Upload the log of a session.")
    times = np.array([row.t_s for row in found])
    if (back := np.flatnonzero(np.diff(times) < 0)).size:
        raise UndecodableFile(
            "decisions that are not in the order of their times", f"line {found[int(back[0]) + 1].line}, column t_s", MEND
        )
    return Log(
        ran,
        head,
        period_s,
        np.array([row.line for row in found], dtype=np.int64),
        times,
        np.array([row.due_s for row in found]),
        np.array([row.beta for row in found]),
        np.array([row.amplitude_ma for row in found]),
        _one([row.unit for row in found], "unit"),
        _one([row.source for row in found], "source"),
        np.array([row.followed for row in found], dtype=np.bool_),
        np.array([row.hold for row in found], dtype=np.int64),
        np.array([row.log_density for row in found]),
        np.array([row.battery_percent for row in found]),
        found[-1].ended if found[-1].ended in ENDS else None,
    )


class _Cells(NamedTuple):
    """A row as it was read, in the order of `Log`."""

    line: int
    t_s: float
    due_s: float
    beta: float
    amplitude_ma: float
    unit: str
    source: str
    followed: bool
    hold: int
    log_density: float
    battery_percent: float
    ended: str


def _row(row: list[str], at: dict[str, int], line: int, nonce: str | None) -> _Cells:
    def text(name: str) -> str:
        return row[at[name]].strip() if name in at else ""

    def number(name: str) -> float | None:
        try:
            return parse_number(text(name))
        except NotANumber as error:
            known = f"line {line}, column {name}"
            raise UndecodableFile(f"{shown(row[at[name]])} is no number", known, MEND, "a cell holds text, not a number", known) from error

    t_s, amplitude = number("t_s"), number("amplitude_ma")
    due_s = number("due_s") if "due_s" in at else t_s
    if t_s is None or due_s is None or amplitude is None:
        raise UndecodableFile("a decision without its time or its amplitude", f"line {line}", MEND)
    beta = None if set(text("reasons").split()) & NO_BETA else number("beta")
    hold, density, battery = number("hold"), number("log_density"), number("battery_percent")
    if nonce is not None and text("sealed"):
        try:
            hold, density = row_of(text("sealed"), nonce)
        except ValueError as error:
            raise UndecodableFile("a masked cell of this blinded log is not whole", f"line {line}, column sealed", MEND) from error
    return _Cells(
        line=line,
        t_s=t_s,
        due_s=due_s,
        beta=math.nan if beta is None else beta,
        amplitude_ma=amplitude,
        unit=text("unit") if beta is not None else "",
        source=text("source") if beta is not None else "",
        followed=text("action") == "policy",
        hold=-1 if hold is None else int(hold),
        log_density=math.nan if density is None else density,
        battery_percent=math.nan if battery is None else battery,
        ended=text("ended"),
    )


def _one(texts: list[str], what: str) -> str:
    """Find the one unit or source that all rows with beta name. Raises UndecodableFile for several, or for a unit that is none."""
    named = {t for t in texts if t}
    if what == "unit":
        named = {known_unit(t) or "" for t in named}
        if "" in named:
            raise UndecodableFile("the unit of beta is none that is known here", "column unit", "Give beta in uV or mV.")
    if len(named) > 1:
        raise UndecodableFile(
            f"beta of several {what}s in one log: {', '.join(sorted(map(shown, named)))}",
            f"column {what}",
            MEND,
            f"beta of several {what}s in one log",
        )
    return named.pop() if named else ("uV" if what == "unit" else "")
