"""The controller's own log, as `betaloop control --log` and the runner of a bundle write it.

A row holds the beta amplitude of the period that ended at `due_s`, and the amplitude decided for the time from `t_s` to the next row's. In
a table of steps both belong to two rows: here each beta stands beside the amplitude that was in force while it was measured.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray

from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, Hemisphere, TraceSource, UndecodableFile
from ml.formats.redaction_record import Redaction
from ml.formats.tables.columns import LARGEST, LOG_KIND_LINE, Columns
from ml.formats.tables.numbers import NotANumber, known_unit, parse_number, shown
from ml.formats.tables.steps import GRID_TOLERANCE, decode_columns

NEWEST = 2
"""Version of logs that this decoder reads at the most."""
MARK = b"# betaloop controller log"
_KIND = re.compile(r"# betaloop controller log, version (?P<version>\d{1,4})(, period (?P<period>\d+(\.\d*)?) s(?P<ran>.*))?")
_NUMBER = r"\d{1,3}(?:\.\d{1,9})?"
_RAN = re.compile(
    r", policy (?P<policy_id>\d{1,9}), network (?P<network_sha256>[0-9a-f]{64})(?:, side (?P<side>left|right))?"
    rf", limits (?P<min_ma>{_NUMBER}) to (?P<max_ma>{_NUMBER}) mA, cDBS (?P<cdbs_ma>{_NUMBER}) mA, ramp (?P<ramp_ma_per_s>{_NUMBER}) mA/s"
)
NEEDED = ("t_s", "beta", "unit", "amplitude_ma")
OPTIONAL = ("due_s", "source", "reasons")
NO_BETA = frozenset({"no_beta", "invalid_beta", "wrong_signal", "late_sample"})
"""Reasons of a decision whose beta amplitude is not one of the period that ended."""
UNKNOWN_START = 0.05
"""A step's amplitude counts as known where the first decision came within this share of the period."""
MEND = f"Upload the log as the controller wrote it, with its first line ('{LOG_KIND_LINE}')."

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Ran:
    """What the first line of a log says of the controller: its policy, by number and by the SHA-256 of its network, and its limits."""

    policy_id: int
    network_sha256: str
    side: Hemisphere | None
    min_ma: float
    max_ma: float
    cdbs_ma: float
    ramp_ma_per_s: float

    @classmethod
    def of(cls, said: Mapping[str, Any]) -> Ran:
        """From texts or numbers by name. Raises UndecodableFile where they do not fit together."""
        numbers = {name: float(said[name]) for name in ("min_ma", "max_ma", "cdbs_ma", "ramp_ma_per_s")}
        if not 0 <= numbers["min_ma"] <= numbers["cdbs_ma"] <= numbers["max_ma"] <= LARGEST["amplitude_ma"]:
            what = f"limits of {numbers['min_ma']:g} to {numbers['max_ma']:g} mA around a cDBS amplitude of {numbers['cdbs_ma']:g} mA"
            raise UndecodableFile(what, "line 1", MEND)
        return cls(int(said["policy_id"]), said["network_sha256"], cast("Hemisphere | None", said["side"]), **numbers)


@dataclass(frozen=True)
class Log:
    """The rows of a log: decided at `t_s`, for the period that ended at `due_s`; beta (NaN: none) in `unit` from `source`; amplitude.

    `ran` is None for logs of version 1, which do not tell.
    """

    ran: Ran | None
    kind_line: str
    period_s: float
    lines: NDArray[np.int64]
    t_s: Floats
    due_s: Floats
    beta: Floats
    amplitude_ma: Floats
    unit: str
    source: str


def is_log(path: Path) -> bool:
    """Whether a file says in its first line that it is a controller's log."""
    with path.open("rb") as stream:
        return stream.read(200).removeprefix(b"\xef\xbb\xbf").startswith(MARK)


def decode_log(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a controller's log into beta and the amplitude in force, one row per period; the last decision has no period yet.

    Raises:
        UndecodableFile: another version or period, a column is missing, or a cell that is no number; names the line.
    """
    log = _read(path, options)
    columns = Columns(
        names={"t_s": "due_s", "beta": "beta", "amplitude_ma": "amplitude_ma"},
        units={"t_s": None, "beta": log.unit, "amplitude_ma": "mA"},
        lines=log.lines,
        values={"t_s": log.due_s, "beta": log.beta, "amplitude_ma": in_force(log)},
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
    settings = {**recording.settings, "controller": asdict(log.ran)} if log.ran else recording.settings
    side = log.ran.side if log.ran else recording.hemisphere
    made = replace(recording, kind="controller_log", hemisphere=side, traces=traces, settings=settings)
    return replace(decoded, recordings=(made,))


def in_force(log: Log) -> Floats:
    """Mean amplitude in force over the period that ends at each row, mA, [n]; NaN before the first decision and where rows are missing."""
    t, period = log.t_s, log.period_s
    sums = np.concatenate([[0.0], np.cumsum(log.amplitude_ma[:-1] * np.diff(t))])

    def delivered(until: Floats) -> Floats:
        """mA s since the first decision."""
        j = np.maximum(np.searchsorted(t, until, side="right") - 1, 0)
        return np.asarray(sums[j] + log.amplitude_ma[j] * (until - t[j]), dtype=np.float64)

    begin = log.due_s - period
    mean = (delivered(log.due_s) - delivered(begin)) / period
    known = t[0] - begin <= UNKNOWN_START * period
    known &= np.concatenate([[False], np.diff(log.due_s) <= (1 + GRID_TOLERANCE) * period])
    return np.where(known, mean, np.nan)


def redact_log(source: Path, target: Path, options: DecodeOptions) -> Redaction:
    """Write a log of its numbers alone, which decodes to the same recording. Raises UndecodableFile as `decode_log`, before it writes."""
    log = _read(source, options)
    decode_log(source, options, "log")
    rows = zip(log.t_s.tolist(), log.due_s.tolist(), log.beta.tolist(), log.amplitude_ma.tolist(), strict=True)
    kept = log.source if log.source in get_args(TraceSource) else "table"
    with target.open("w", encoding="utf-8", newline="") as out:
        out.write(f"{log.kind_line}\nt_s,due_s,beta,unit,source,amplitude_ma\n")
        for t, due, beta, amplitude in rows:
            out.write(f"{t!r},{due!r},{'' if beta != beta else repr(beta)},{log.unit},{kept},{amplitude!r}\n")
    return Redaction(removed=["what the controller noted beside beta and amplitude"])


@contextmanager
def _opened(path: Path) -> Iterator[Iterator[str]]:
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as stream:
        yield iter(stream)


def _read(path: Path, options: DecodeOptions) -> Log:
    with _opened(path) as lines:
        first = next(lines, "").strip().rstrip(", ;")
        period_s, ran = _kind(first, options)
        reader = csv.reader(lines)
        headers = [h.strip() for h in next(reader, [])]
        missing = [name for name in NEEDED if name not in headers]
        if missing:
            what = f"a controller's log without the column{'s' if len(missing) > 1 else ''} {', '.join(missing)}"
            raise UndecodableFile(what, "line 2", MEND)
        at = {name: headers.index(name) for name in (*NEEDED, *OPTIONAL) if name in headers}
        found: list[tuple[int, float, float, float, float, str, str]] = []
        for row in reader:
            line = reader.line_num + 1
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(headers):
                raise UndecodableFile(f"{len(row)} cells where the header has {len(headers)}", f"line {line}", MEND)
            if len(found) >= options.max_table_rows:
                raise UndecodableFile(f"more than {options.max_table_rows} rows", f"line {line}", "Upload one session per log.")
            found.append(_row(row, at, line))
    if not found:
        raise UndecodableFile("the log has no decision", "after line 2", "Upload the log of a session.")
    line_numbers, t_s, due_s, beta, amplitude, units, sources = (list(column) for column in zip(*found, strict=True))
    times = np.array(t_s, dtype=np.float64)
    if (back := np.flatnonzero(np.diff(times) < 0)).size:
        raise UndecodableFile(
            "decisions that are not in the order of their times", f"line {line_numbers[int(back[0]) + 1]}, column t_s", MEND
        )
    return Log(
        ran,
        first,
        period_s,
        np.array(line_numbers, dtype=np.int64),
        times,
        np.array(due_s, dtype=np.float64),
        np.array(beta, dtype=np.float64),
        np.array(amplitude, dtype=np.float64),
        _one(units, "unit"),
        _one(sources, "source"),
    )


def _kind(first: str, options: DecodeOptions) -> tuple[float, Ran | None]:
    """Period, s, and what ran. Raises UndecodableFile for a first line that is cut or of another version or period."""
    kind = _KIND.match(first)
    if kind is not None and int(kind["version"]) > NEWEST:
        what = f"a controller's log of version {kind['version']}; this service reads versions up to {NEWEST}"
        raise UndecodableFile(what, "line 1", "Bring this service up to date.")
    said = None if kind is None or kind["ran"] is None else _RAN.fullmatch(kind["ran"])
    whole = kind is not None and (kind["ran"] == "" if int(kind["version"]) == 1 else said is not None)
    if kind is None or not whole:
        raise UndecodableFile("the first line of this controller's log is not whole", "line 1", MEND)
    period_s = float(kind["period"])
    if abs(period_s - options.period_s) > GRID_TOLERANCE * options.period_s:
        what = f"a controller that decided every {period_s:g} s, where the participant's period is {options.period_s:g} s"
        raise UndecodableFile(what, "line 1", "Set the participant's period to the controller's.")
    return options.period_s, Ran.of(said.groupdict()) if said else None


def _row(row: list[str], at: dict[str, int], line: int) -> tuple[int, float, float, float, float, str, str]:
    def number(name: str) -> float | None:
        try:
            return parse_number(row[at[name]])
        except NotANumber as error:
            known = f"line {line}, column {name}"
            raise UndecodableFile(f"{shown(row[at[name]])} is no number", known, MEND, "a cell holds text, not a number", known) from error

    t_s, amplitude = number("t_s"), number("amplitude_ma")
    due_s = number("due_s") if "due_s" in at else t_s
    if t_s is None or due_s is None or amplitude is None:
        raise UndecodableFile("a decision without its time or its amplitude", f"line {line}", MEND)
    reasons = set(row[at["reasons"]].split()) if "reasons" in at else set()
    beta = None if reasons & NO_BETA else number("beta")
    unit = row[at["unit"]].strip() if beta is not None else ""
    source = row[at["source"]].strip() if beta is not None and "source" in at else ""
    return line, t_s, due_s, float("nan") if beta is None else beta, amplitude, unit, source


def _one(texts: list[str], what: str) -> str:
    """The one unit or source that all rows with beta name. Raises UndecodableFile for several, or for a unit that is none."""
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
