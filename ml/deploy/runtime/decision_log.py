"""The log of a controller: a kind line, a line that says whose session it is, a header, and one row per decision.

The row of a decision has the beta amplitude of the period that ended at `due_s`. Its amplitude applies from `t_s` to the next decision's.
So beta and amplitude of one row are those of two steps. Readers recognise the file by its first line. The second line is JSON, so that an
uploaded log finds its session; versions before 3 lack it.
"""

from __future__ import annotations

import csv
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from .envelope import OF_THE_CONTROLLER, BetaSample, Decision, reason_names
from .slot import mask

VERSION = 3
NONCE_DIGITS = 32
"""Hexadecimal digits that the masked text of a blinded log begins with."""
FACTS_BYTES = 2048
"""The facts of a blinded log take this much, whatever they are."""
_ROW = struct.Struct(">id")
COLUMNS = (
    "t_s", "due_s", "beta", "unit", "source", "valid", "window", "fraction", "requested_ma", "amplitude_ma", "action", "reasons",
    "latency_us", "signal_us", "late_ms", "missed", "hold", "log_density", "battery_percent", "ended", "detail",
    "sealed",
)  # fmt: skip


class LogFailed(OSError):
    """The log is there already, or cannot be written."""


class Row(NamedTuple):
    """One decision for the log.

    Attributes:
        due_s: end of the period whose beta amplitude came, seconds from the session's start. sample: that beta amplitude, if one came.
        decision: what was decided. window: beta amplitudes so far, the newest last.
        latency_us, signal_us: time that the decision, and P_beta before it, took. late_s, missed: after the period's end, and too late.
        drawn: index and log density of the drawn amplitude that is delivered; None where none is.
        battery_percent: charge of the tablet's own battery; None where it has none.
        ended: how the session ended with this row; None where it goes on.
    """

    due_s: float
    sample: BetaSample | None
    decision: Decision
    window: list[float]
    latency_us: float
    signal_us: float = 0.0
    late_s: float = 0.0
    missed: bool = False
    drawn: tuple[int, float | None] | None = None
    battery_percent: float | None = None
    ended: str | None = None


def kind_line(period_s: float) -> str:
    """Write the first line of a log, without its end."""
    return f"# betaloop controller log, version {VERSION}, period {period_s:g} s"


def description_line(facts: Mapping[str, Any]) -> str:
    """Write the second line of a log, without its end."""
    return "# " + json.dumps(facts, sort_keys=True, ensure_ascii=True, allow_nan=False)


def cells(row: Row) -> list[Any]:
    """List the cells of a row, in the order of `COLUMNS`."""
    sample, decision = row.sample, row.decision
    shown = row.window[len(row.window) - decision.valid :] if decision.valid else []
    hold, log_density = row.drawn or ("", None)
    return [
        f"{decision.t_s:.3f}",
        f"{row.due_s:.3f}",
        "" if sample is None else f"{sample.beta:.9g}",
        "" if sample is None else sample.signal.unit,
        "" if sample is None else sample.signal.source,
        decision.valid,
        " ".join(f"{beta:.6g}" for beta in shown),
        "" if decision.fraction is None else f"{decision.fraction:.7g}",
        "" if decision.requested_ma is None else f"{decision.requested_ma:.6g}",
        f"{decision.amplitude_ma:.9g}",
        "cdbs" if decision.fallback else "policy",
        " ".join(reason_names(decision.reasons)),
        f"{row.latency_us:.1f}",
        f"{row.signal_us:.1f}",
        f"{1000.0 * row.late_s:.3f}",
        int(row.missed),
        hold,
        "" if log_density is None else f"{log_density:.12g}",
        "" if row.battery_percent is None else f"{row.battery_percent:g}",
        row.ended or "",
        decision.detail,
        "",
    ]


def seal_facts(facts: Mapping[str, Any], nonce: str) -> str:
    """Seal the head of a blinded log, as text that reveals nothing by its look or length."""
    plain = json.dumps(facts, sort_keys=True, allow_nan=False).encode().ljust(FACTS_BYTES)
    return nonce + mask(plain, nonce, "facts").hex()


def seal_row(number: int, drawn: tuple[int, float | None] | None, nonce: str) -> str:
    """Seal hold and log density of a row, as text of one length; -1 and NaN where nothing was drawn."""
    hold, density = drawn or (-1, None)
    plain = _ROW.pack(hold, float("nan") if density is None else density)
    return f"{number}:{mask(plain, nonce, f'row {number}').hex()}"


def masked(row: Row, number: int, nonce: str) -> list[Any]:
    """Mask a row of a blinded session: no draws, no timing, no request and no reason of the controller. Any of them separates a network
    from a schedule.

    The amplitude is as it was.
    """
    seen = row.decision._replace(reasons=row.decision.reasons & ~OF_THE_CONTROLLER)
    seen = seen._replace(detail="") if row.decision.reasons & OF_THE_CONTROLLER else seen
    told = dict(zip(COLUMNS, cells(row._replace(decision=seen)), strict=True))
    hidden = dict.fromkeys(("fraction", "requested_ma", "latency_us", "signal_us", "late_ms", "hold", "log_density"), "")
    return list((told | hidden | {"sealed": seal_row(number, row.drawn, nonce)}).values())


class LogFile:
    """A new file that gets one row per decision, each handed to the operating system at once, so that a killed process loses none.

    Args:
        path: of the file; one that holds something already is not written over.

    Raises:
        LogFailed: the file is there already or cannot be written, at the start or at any row.
    """

    def __init__(self, path: Path, period_s: float, facts: Mapping[str, Any]) -> None:
        self._path = path
        self._nonce = str(facts.get("sealed") or "")[:NONCE_DIGITS]
        self._rows = 0
        try:
            if path.is_file() and path.stat().st_size:
                raise LogFailed(f"the log {path} is there already: name a new file, no decision is written over")
            self._stream = path.open("w", newline="", encoding="utf-8")
        except OSError as error:
            raise self._failure(error) from error
        self._writer = csv.writer(self._stream)
        self._lines(kind_line(period_s), description_line(facts))
        self._row(COLUMNS)

    def write(self, row: Row) -> None:
        """Add a row. Raises LogFailed."""
        self._row(masked(row, self._rows, self._nonce) if self._nonce else cells(row))
        self._rows += 1

    def close(self) -> None:
        """Close the file. Raises LogFailed where what was written cannot be kept."""
        try:
            self._stream.close()
        except OSError as error:
            raise self._failure(error) from error

    def _lines(self, *lines: str) -> None:
        try:
            self._stream.write("".join(f"{line}\r\n" for line in lines))
            self._stream.flush()
        except OSError as error:
            raise self._failure(error) from error

    def _row(self, row: Any) -> None:
        try:
            self._writer.writerow(row)
            self._stream.flush()
        except OSError as error:
            raise self._failure(error) from error

    def _failure(self, error: OSError) -> LogFailed:
        return error if isinstance(error, LogFailed) else LogFailed(f"the log {self._path} cannot be written: {error.strerror}")
