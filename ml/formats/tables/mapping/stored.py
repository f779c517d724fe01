"""The stored form of a table of steps or LFP that a column mapping read, and its decoder. It gives one recording per side, with all its
channels.

Two lines say what follows: the kind with its version, and as JSON the start and what each column holds. Then come a line of names and the
rows, each with the number of the line that it had in the file which was sent.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.options import DecodeOptions
from ml.formats.recording import (
    DecodedFile,
    FileReport,
    Hemisphere,
    RecordingLog,
    SampleLog,
    SpectrumLog,
    TraceLog,
    UndecodableFile,
    fingerprint,
)
from ml.formats.tables.cells.plain import read_plain
from ml.formats.tables.columns import Columns
from ml.formats.tables.mapping.model import AMPLITUDES, SIGNALS, MappedColumn
from ml.formats.tables.steps import decode_columns

MARK = "# betaloop mapped table, version 1"
HEAD_LINES = 3
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MappedTable:
    """Steps or samples in the stated units.

    Attributes:
        started_at: where t_s is 0, where the table's times say so.
        columns: what each of `values` holds.
        lines: line of each row in the file that was sent, [rows].
        t_s: seconds from the start, of a step its end, [rows].
        values: numbers of each column, [rows], NaN where there is none.
    """

    started_at: datetime | None
    columns: tuple[MappedColumn, ...]
    lines: NDArray[np.int64]
    t_s: Floats
    values: tuple[Floats, ...]


def write(table: MappedTable, target: Path) -> None:
    """Write the stored form."""
    head = {"started_at": table.started_at.isoformat() if table.started_at else None, "columns": [asdict(c) for c in table.columns]}
    cells = [table.lines.astype(str).tolist(), *([("" if v != v else repr(v)) for v in c.tolist()] for c in (table.t_s, *table.values))]
    with target.open("w", encoding="utf-8", newline="") as out:
        out.write(f"{MARK}\n# {json.dumps(head, sort_keys=True)}\n")
        out.write(",".join(["line", "t_s", *(c.role for c in table.columns)]) + "\n")
        out.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))


def read(path: Path, options: DecodeOptions) -> MappedTable:
    """Read the table of a stored file. Raises UndecodableFile for one that was changed since."""
    hint = "Restore the stored files from a backup."
    with path.open(encoding="utf-8") as stream:
        top = [line.rstrip("\n") for line in islice(stream, HEAD_LINES)]
        if len(top) < HEAD_LINES or top[0] != MARK:
            raise UndecodableFile("no mapped table of a version known here", "line 1", hint)
        head = json.loads(top[1].removeprefix("# "))
        columns = tuple(MappedColumn(**c) for c in head["columns"])
        used = list(range(2 + len(columns)))
        found = read_plain(stream, ",", len(used), used, max(options.max_lfp_rows, options.max_table_rows))
    if found is None:
        raise UndecodableFile("the stored table was changed", f"after line {HEAD_LINES}", hint)
    started_at = datetime.fromisoformat(head["started_at"]) if head["started_at"] else None
    return MappedTable(started_at, columns, found[0].astype(np.int64), found[1], tuple(found[i] for i in used[2:]))


def decode_mapped(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a stored file into a recording per side. Raises UndecodableFile naming the line of the file that was sent."""
    return decode_table_of(read(path, options), options, name or path.name)


def decode_table_of(table: MappedTable, options: DecodeOptions, name: str) -> DecodedFile:
    """Decode recordings from a table. Raises UndecodableFile naming line and column."""
    report = FileReport(name)
    sides = list(dict.fromkeys(c.side for c in table.columns))
    recordings = tuple(_side(side, table, options, report) for side in sides)
    if table.started_at is not None:
        report.understood.append(f"the times say that it starts at {table.started_at:%Y-%m-%d %H:%M:%S} UTC")
    return DecodedFile(recordings, (report,))


def _side(side: Hemisphere | None, table: MappedTable, options: DecodeOptions, report: FileReport) -> RecordingLog:
    """Decode one side: its amplitude, and every channel's own traces."""
    mine = [(c, v) for c, v in zip(table.columns, table.values, strict=True) if c.side == side]
    amplitudes = [(c, v) for c, v in mine if c.role in AMPLITUDES]
    signals = [(c, v) for c, v in mine if c.role in SIGNALS]
    parts = [_decode_signal([one, *(amplitudes if i == 0 else [])], table, options, report, side, i == 0) for i, one in enumerate(signals)]
    if not parts:
        parts = [_decode_signal(amplitudes, table, options, report, side, True)]
    first = parts[0]
    told: list[str | bytes | NDArray[np.float32]] = [str(side), str(table.started_at), *(p.fingerprint for p in parts)]
    told += [c.channel or "" for c, _ in signals]
    traces: list[TraceLog] = []
    spectra: list[SpectrumLog] = []
    samples: list[SampleLog] = []
    quality: dict[str, Any] = {}
    for i, part in enumerate(parts):
        channel = (signals[i][0].channel or _default_name(signals, i)) if signals else None
        made = [_with_channel(t, channel) for t in part.traces]
        traces += made
        spectra += [replace(s, channel=channel or s.channel) for s in part.spectra]
        samples += [replace(s, channel=channel or s.channel) for s in part.samples]
        quality |= {f"{t.stream}.{t.channel}": {"valid_fraction": round(float(t.valid.mean()), 6)} for t in made}
    return replace(
        first,
        hemisphere=side,
        clock="table" if table.started_at is None else "pc",
        started_at=table.started_at,
        traces=tuple(traces),
        spectra=tuple(spectra),
        samples=tuple(samples),
        quality=quality,
        fingerprint=fingerprint("mapped table", told),
    )


def _default_name(signals: Sequence[tuple[MappedColumn, Floats]], i: int) -> str | None:
    """Name a channel without a stated name: as in tables of one channel, else by its column."""
    return None if len(signals) == 1 else f"column {signals[i][0].number}"


def _with_channel(trace: TraceLog, channel: str | None) -> TraceLog:
    if trace.stream == "amplitude":
        return trace
    details = {**trace.details, "unit_from": "mapping"}
    return replace(trace, channel=channel or trace.channel, details=details)


def _decode_signal(
    given: Sequence[tuple[MappedColumn, Floats]],
    table: MappedTable,
    options: DecodeOptions,
    report: FileReport,
    side: Hemisphere | None,
    first: bool,
) -> RecordingLog:
    """Decode a recording of one signal, and of the amplitudes with it."""
    roles = {"beta_power": "beta"}
    units: dict[str, str | None] = {"t_s": None, **{roles.get(c.role, c.role): c.unit for c, _ in given}}
    columns = Columns(
        names={"t_s": "time"} | {roles.get(c.role, c.role): str(c.number) for c, _ in given},
        units=units,
        lines=table.lines,
        values={"t_s": table.t_s.copy()} | {roles.get(c.role, c.role): v for c, v in given},
    )
    decoded = decode_columns(columns, options, report.name)
    own = decoded.reports[0]
    channel = next((c.channel for c, _ in given if c.role in SIGNALS and c.channel), None)
    whose = " ".join(part for part in (side, channel) if part)
    for ours, found in ((report.understood, own.understood), (report.flagged, own.flagged), (report.ignored, own.ignored)):
        if ours is not report.understood or first:
            ours.extend(f"{whose}: {line}" if whose else line for line in found)
    report.repaired.extend(line for line in own.repaired if line not in report.repaired)
    return decoded.recordings[0]
