"""Times of open fists in a hand-grasp test, the input of eq:grasp_speed. Source: format notes, A″."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, FileReport, Hemisphere, OutcomeLog, UndecodableFile
from ml.formats.source import Source
from ml.formats.tables.cells.delimited import TextTable, read_delimited
from ml.formats.tables.cells.numbers import column_name, shown
from ml.formats.tables.columns import BETA_NAMES
from ml.formats.tables.outcome_table import OutcomeTable, cell
from ml.formats.tables.removed import removed_columns
from ml.qoc import PLAUSIBLE_INTERVAL_S

SECONDS = frozenset({"t_s", "t", "time", "time_s", "open_fist_s", "seconds"})
MICROSECONDS = frozenset({"t_us", "time_us", "timestamp_us", "open_fist_us", "microseconds"})
TELLING = frozenset({"open_fist_s", "open_fist_us", "open_fist"})
"""Names that no other table has for its times."""

LEAST_FRAMES = 20
"""So many intervals, nearly all under the shortest plausible one, are the frames of a hand tracker."""

SLOWEST_S = 30.0
"""No hand opens so rarely in a test: such times are in another unit."""

COUNTERS = frozenset({"", "n", "i", "index", "number", "grasp", "count", "unnamed:_0"})
EVENTS = frozenset({"event", "events", "state", "status", "phase", "gesture", "hand_state", "action"})
"""Names of a column that says what happened at a time."""
OPENED = frozenset({"open", "opening", "opened", "open_fist", "open fist", "open_hand", "open hand"})
CLOSED = frozenset({"close", "closing", "closed", "closed_fist", "closed fist", "closed_hand", "closed hand", "fist"})
HANDS: dict[str, Hemisphere] = {"l": "left", "left": "left", "r": "right", "right": "right"}


@dataclass(frozen=True, slots=True, eq=False)
class GraspLog(OutcomeLog):
    """One hand's test: times of open fists in s, shape [n], strictly increasing; which intervals are implausible, shape [n - 1]."""

    hand: Hemisphere | None
    open_fist_s: NDArray[np.float64]
    implausible: NDArray[np.bool_]


def looks_like_grasps(headers: Sequence[str]) -> bool:
    """Check whether a table with these headers is a grasp test: times and hands, or nothing but times."""
    keys = [column_name(header)[0] for header in headers]
    if any(key in BETA_NAMES or key.startswith(("lfp", "amplitude")) for key in keys):
        return False
    times = [key for key in keys if key in SECONDS | MICROSECONDS | TELLING]
    others = [key for key in keys if key not in times and key not in COUNTERS and key != "hand"]
    return bool(times) and ("hand" in keys or any(key in TELLING for key in keys) or not others)


def decode_grasps(path: Source, options: DecodeOptions | None = None, name: str | None = None) -> DecodedFile:
    """Decode a table of open-fist times (`t_s` or `t_us`, optional `hand` and `event`).

    Rows of closed fists are excluded where an `event` names them. Implausible intervals (under 80 ms, over 3 s) are flagged and kept.

    Raises:
        UndecodableFile: no time column, text for a number, times that do not increase, an unknown hand or event; names line and column.
    """
    table = read_delimited(path, (options or DecodeOptions()).max_table_rows, "t_s (or t_us) and optionally hand")
    names = [column_name(header) for header in table.headers]
    column, scale = _time_column(table, names)
    hand_column = next((i for i, (key, _) in enumerate(names) if key == "hand"), None)
    event_column = next((i for i, (key, _) in enumerate(names) if key in EVENTS), None)
    times = table.numbers(column, table.decimal_mark([column]), "t_s") * scale
    report = FileReport(name or path.name)
    report.repaired.extend(table.notes)
    known = (column, hand_column, event_column)
    report.removed.extend(removed_columns(header for i, header in enumerate(table.headers) if i not in known))
    hands: dict[Hemisphere | None, list[int]] = {}
    closed = 0
    for i, row in enumerate(table.rows):
        if event_column is not None and _is_closed(row[event_column], table, i, event_column):
            closed += 1
            continue
        hands.setdefault(None if hand_column is None else _hand(row[hand_column], table.lines[i]), []).append(i)
    if closed:
        report.ignored.append(f"{closed} {'row' if closed == 1 else 'rows'} of closed fists")
    logs = tuple(_one_hand(hand, np.array(rows), times, table, report) for hand, rows in hands.items())
    if not logs:
        what = "the table has no rows of open fists" if closed else "the table has a header but no rows"
        raise UndecodableFile(what, "after line 1", "Add one row per open fist.")
    return DecodedFile((), (report,), outcomes=logs)


def _time_column(table: TextTable, names: list[tuple[str, str | None]]) -> tuple[int, float]:
    for i, (key, unit) in enumerate(names):
        micro = unit is not None and unit.lower() in ("us", "µs", "μs")
        if key in MICROSECONDS or (key in SECONDS | TELLING and micro):
            return i, 1e-6
        if key in SECONDS | TELLING and unit is not None and unit.lower() == "ms":
            return i, 1e-3
        if key in SECONDS | TELLING and (unit is None or unit.lower() in ("s", "sec", "seconds")):
            return i, 1.0
    found = ", ".join(shown(header.strip()) for header in table.headers[:20])
    what = "no column of times"
    raise UndecodableFile(f"{what}; found: {found}", "line 1", "Name the column t_s (seconds) or t_us (microseconds).", what)


def _is_closed(cell: str, table: TextTable, row: int, column: int) -> bool:
    event = cell.strip().lower()
    if event not in OPENED | CLOSED:
        where = f"line {table.lines[row]}, column {shown(table.headers[column].strip())}"
        hint = "Write open or closed, or leave the column out and keep one row per open fist."
        raise UndecodableFile(f"unknown event {shown(cell)}", where, hint, "unknown event")
    return event in CLOSED


def _hand(cell: str, line: int) -> Hemisphere:
    hand = HANDS.get(cell.strip().lower())
    if hand is None:
        raise UndecodableFile(f"unknown hand {shown(cell)}", f"line {line}, column hand", "Write L or R.", "unknown hand")
    return hand


def _one_hand(
    hand: Hemisphere | None, rows: NDArray[np.int64], times: NDArray[np.float64], table: TextTable, report: FileReport
) -> GraspLog:
    t = times[rows]
    bad = np.flatnonzero(np.isnan(t))
    if bad.size:
        where = f"line {table.lines[rows[bad[0]]]}, column of times"
        raise UndecodableFile("an open fist without a time", where, "Delete the row or fill it in.")
    intervals = np.diff(t)
    back = np.flatnonzero(intervals <= 0)
    if back.size:
        line = table.lines[rows[back[0] + 1]]
        hint = "Sort the rows by time; keep one row per open fist, and name the hand where both are in one table."
        raise UndecodableFile("times must increase", f"line {line}, column of times", hint)
    if intervals.size >= LEAST_FRAMES and np.mean(intervals < PLAUSIBLE_INTERVAL_S[0]) > 0.9:
        every = 1000 * float(np.median(intervals))
        what = f"{t.size} times that follow each other every {every:.0f} ms: frames of a hand tracker, not open fists"
        raise UndecodableFile(what, "column of times", "Upload the times at which the hand was open, one row per open fist.")
    if intervals.size and float(np.median(intervals)) > SLOWEST_S:
        what = f"open fists follow each other every {float(np.median(intervals)):.6g} s, which no test has"
        raise UndecodableFile(what, "column of times", "Give the times in seconds; if they are milliseconds, name the column t_s [ms].")
    implausible = (intervals < PLAUSIBLE_INTERVAL_S[0]) | (intervals > PLAUSIBLE_INTERVAL_S[1])
    whose = "" if hand is None else f"{hand} hand: "
    report.understood.append(f"{whose}{t.size} open fists")
    if t.size < 2:
        report.flagged.append(f"{whose}fewer than two open fists: the grasp frequency is undefined")
    if count := int(implausible.sum()):
        low, high = PLAUSIBLE_INTERVAL_S
        named, them = ("interval", "it") if count == 1 else ("intervals", "them")
        report.flagged.append(f"{whose}{count} {named} outside {low:g} to {high:g} s: kept, look at {them}")
    return GraspLog(hand, t, implausible)


def _lines(hands: Sequence[GraspLog]) -> list[str]:
    """Write `t_s`, and `hand` where a hand is named."""
    if len(hands) == 1 and hands[0].hand is None:
        return ["t_s", *(cell(t) for t in hands[0].open_fist_s.tolist())]
    return ["t_s,hand", *(f"{cell(t)},{h.hand}" for h in hands for t in h.open_fist_s.tolist())]


def _mapped_cells(
    table: TextTable, places: Mapping[str, int], t_s: NDArray[np.float64], absolute: bool
) -> tuple[list[str], list[list[str]]]:
    known = t_s[np.isfinite(t_s)]
    times = t_s - known[0] if absolute and known.size else t_s  # moments count from the first
    hand = [place for role, place in places.items() if role == "hand"]
    return ["t_s", "hand"][: 1 + len(hand)], [[cell(t)] + [row[i] for i in hand] for t, row in zip(times, table.rows, strict=True)]


GRASP_TESTS = OutcomeTable(
    kind="grasp",
    name="grasp test",
    holds="times of open fists",
    log=GraspLog,
    roles=("hand",),
    recognises=looks_like_grasps,
    decode=decode_grasps,
    lines=_lines,
    mapped_cells=_mapped_cells,
)
