"""Model of a column mapping: which line of a table names its columns, what each column has, and how times are written."""

from __future__ import annotations

import hmac
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from hashlib import sha256
from typing import Any, Literal

from ml.formats.recording import Hemisphere
from ml.formats.tables.cells.numbers import column_name
from ml.formats.tables.outcome_tables import BY_KIND, OUTCOME_TABLES

Holds = Literal["steps", "lfp", "tremor", "grasp"]
"""What a table holds: steps of beta, samples of LFP, minutes of tremor, times of open fists."""

TimeFormat = Literal[
    "seconds", "milliseconds", "microseconds", "minutes", "samples", "unix_s", "unix_ms", "unix_us", "unix_ns", "iso", "dmy", "mdy", "excel"
]
RELATIVE: Mapping[str, float] = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "minutes": 60.0}
"""Seconds per unit of times that count from the session's start; `samples` count too, by the stated rate."""
UNIX: Mapping[str, float] = {"unix_s": 1.0, "unix_ms": 1e-3, "unix_us": 1e-6, "unix_ns": 1e-9}
WRITTEN = ("iso", "dmy", "mdy", "excel")
"""Dates and times as people write them: year, day or month first, or the day numbers of a spreadsheet. Their zone must be stated."""

SIGNALS = ("beta", "beta_power", "lfp")
AMPLITUDES = ("amplitude_ma", "amplitude_fraction")
ROLES = ("time", *SIGNALS, *AMPLITUDES, *(role for one in OUTCOME_TABLES for role in one.roles))
"""What a column may hold. A column that no mapping names is removed."""

_VOLTAGES = ("uV", "nV", "mV", "V")
_RELATIVE_UNITS = ("dB", "z", "a.u.", "device units", "lsb", "counts")
UNITS: Mapping[str, tuple[str, ...]] = {
    "beta": (*_VOLTAGES, *_RELATIVE_UNITS),
    "beta_power": ("uV2", "nV2", "mV2", "V2", "uV2/Hz", *_RELATIVE_UNITS),
    "lfp": _VOLTAGES,
    "amplitude_ma": ("mA", "uA", "A"),
    "amplitude_fraction": ("fraction", "%"),
}
"""Units that a column's numbers may be in, by what it holds. Every one of these columns must state one."""


@dataclass(frozen=True, slots=True)
class MappedColumn:
    """One column: its number from 1, what it holds, its unit, and which side and channel it is of, where that is known."""

    number: int
    role: str
    unit: str | None = None
    side: Hemisphere | None = None
    channel: str | None = None


@dataclass(frozen=True, slots=True)
class TableMapping:
    """Reading of tables with one header.

    Attributes:
        header: keyed hash of the line that names the columns (`header_hash`); the line is found by it wherever it is.
        width: cells of that line.
        unit_lines: lines right below it that are no rows.
        holds: what the table holds.
        time_format: how times are written.
        zone: IANA name of the zone of written times; None for all others.
        rate_hz: samples a second, where times are numbers of samples.
        row_begins: whether the time of a step is that of its begin, not of its end.
        columns: those that are used.
    """

    header: str
    width: int
    unit_lines: int
    holds: Holds
    time_format: TimeFormat
    zone: str | None
    rate_hz: float | None
    row_begins: bool
    columns: tuple[MappedColumn, ...]

    def to_json(self) -> dict[str, Any]:
        """Convert the mapping to plain JSON."""
        return asdict(self)

    @staticmethod
    def from_json(stored: Mapping[str, Any]) -> TableMapping:
        """Read what `to_json` gave."""
        known = {f.name: stored[f.name] for f in fields(TableMapping)}
        return TableMapping(**{**known, "columns": tuple(MappedColumn(**c) for c in stored["columns"])})

    def of_role(self, *roles: str) -> list[MappedColumn]:
        """List the columns with one of these roles, in the file's order."""
        return sorted((c for c in self.columns if c.role in roles), key=lambda c: c.number)

    @property
    def kind(self) -> str:
        """The kind of file that a table becomes."""
        return self.holds if self.holds in BY_KIND else "mapped"


def header_hash(cells: Sequence[str], key: bytes) -> str:
    """Hash a line of names with a key, without regard to case, blanks and hyphens. The names may be those of people, and stay unknown.

    Args:
        cells: of the line.
        key: secret of the installation.
    """
    names = ["\x1e".join(str(part) for part in column_name(cell)) for cell in cells]
    return hmac.new(key, "\x1f".join(["table header", *names]).encode(errors="replace"), sha256).hexdigest()
