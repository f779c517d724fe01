"""Times of open fists in a hand-grasp test, the input of eq:grasp_speed. Source: format notes, A″."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app.ingest.formats.delimited import TextTable, read_delimited
from app.ingest.formats.log import FileReport, UndecodableFile
from app.ingest.formats.numbers import column_name, shown
from app.ingest.formats.options import DecodeOptions
from ml.qoc import PLAUSIBLE_INTERVAL_S

Hand = Literal["left", "right"]
SECONDS = frozenset({"t_s", "t", "time", "time_s", "open_fist_s", "seconds"})
MICROSECONDS = frozenset({"t_us", "time_us", "timestamp_us", "open_fist_us", "microseconds"})
HANDS: dict[str, Hand] = {"l": "left", "left": "left", "r": "right", "right": "right"}


@dataclass(frozen=True, slots=True, eq=False)
class GraspLog:
    """One hand's test: times of open fists in s, shape [n], strictly increasing; which intervals are implausible, shape [n - 1]."""

    hand: Hand | None
    open_fist_s: NDArray[np.float64]
    implausible: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class GraspFile:
    """The tests of one file, and what became of it."""

    hands: tuple[GraspLog, ...]
    report: FileReport


def decode_grasps(path: Path, options: DecodeOptions | None = None, name: str | None = None) -> GraspFile:
    """Decode a table of open-fist times (`t_s` or `t_us`, optional `hand`).

    Implausible intervals (under 80 ms, over 3 s) are flagged and kept.

    Raises:
        UndecodableFile: no time column, text for a number, times that do not increase, an unknown hand; names line and column.
    """
    table = read_delimited(path, (options or DecodeOptions()).max_table_rows, "t_s (or t_us) and optionally hand")
    names = [column_name(header) for header in table.headers]
    column, scale = _time_column(table, names)
    hand_column = next((i for i, (key, _) in enumerate(names) if key == "hand"), None)
    times = table.numbers(column, table.decimal_mark([column])) * scale
    report = FileReport(name or path.name)
    report.repaired.extend(table.notes)
    hands: dict[Hand | None, list[int]] = {}
    for i, row in enumerate(table.rows):
        hands.setdefault(None if hand_column is None else _hand(row[hand_column], table.lines[i]), []).append(i)
    logs = tuple(_one_hand(hand, np.array(rows), times, table, column, report) for hand, rows in hands.items())
    if not logs:
        raise UndecodableFile("the table has a header but no rows", "after line 1", "Add one row per open fist.")
    return GraspFile(logs, report)


def _time_column(table: TextTable, names: list[tuple[str, str | None]]) -> tuple[int, float]:
    for i, (key, unit) in enumerate(names):
        if key in MICROSECONDS or (key in SECONDS and unit is not None and unit.lower() in ("us", "µs", "μs")):
            return i, 1e-6
        if key in SECONDS and (unit is None or unit.lower() in ("s", "sec", "seconds")):
            return i, 1.0
    found = ", ".join(shown(header.strip()) for header in table.headers[:20])
    raise UndecodableFile(f"no column of times; found: {found}", "line 1", "Name the column t_s (seconds) or t_us (microseconds).")


def _hand(cell: str, line: int) -> Hand:
    hand = HANDS.get(cell.strip().lower())
    if hand is None:
        raise UndecodableFile(f"unknown hand {shown(cell)}", f"line {line}, column hand", "Write L or R.")
    return hand


def _one_hand(
    hand: Hand | None, rows: NDArray[np.int64], times: NDArray[np.float64], table: TextTable, column: int, report: FileReport
) -> GraspLog:
    t = times[rows]
    header = table.headers[column].strip()
    bad = np.flatnonzero(np.isnan(t))
    if bad.size:
        raise UndecodableFile(
            "an open fist without a time", f"line {table.lines[rows[bad[0]]]}, column {header}", "Delete the row or fill it in."
        )
    intervals = np.diff(t)
    back = np.flatnonzero(intervals <= 0)
    if back.size:
        line = table.lines[rows[back[0] + 1]]
        raise UndecodableFile("times must increase", f"line {line}, column {header}", "Sort the rows by time; keep one row per open fist.")
    implausible = (intervals < PLAUSIBLE_INTERVAL_S[0]) | (intervals > PLAUSIBLE_INTERVAL_S[1])
    whose = "" if hand is None else f"{hand} hand: "
    report.understood.append(f"{whose}{t.size} open fists")
    if t.size < 2:
        report.flagged.append(f"{whose}fewer than two open fists: the grasp frequency is undefined")
    if count := int(implausible.sum()):
        low, high = PLAUSIBLE_INTERVAL_S
        report.flagged.append(f"{whose}{count} intervals outside {low:g} to {high:g} s: kept, look at them")
    return GraspLog(hand, t, implausible)
