"""What a device keeps beside sessions: trends, snapshots and surveys of spectra, therapy groups and events; from a recording's details.

Everything in it was reduced to numbers, times and known words before it was stored (`ml.formats.percept.details`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import Any

from app.tables.recordings import Recording

_CLOCKS = (timedelta(hours=-12), timedelta(0), timedelta(hours=14))
"""The latest, the middle and the earliest clock on earth against UTC: a day lies within what they call it."""


@dataclass(frozen=True)
class Trend:
    """Averages over ten minutes of one side: times (Unix s), power (device units) and amplitude (mA), all [n]; None where not told."""

    side: str
    unix_s: list[float]
    power: list[float | None]
    amplitude_ma: list[float | None]


@dataclass(frozen=True)
class Spectrum:
    """A spectrum that the device made: of a patient's event (`at`, `label`) or of a survey (`channel`); magnitude in uVp, [n]."""

    side: str | None
    hz: list[float]
    magnitude: list[float]
    at: datetime | None = None
    label: str = ""
    channel: str = ""
    artifact: str = ""


@dataclass(frozen=True)
class Program:
    """One side's program of a therapy group; None where not told. `sensing_hz`: the frequency that the side was sensed at."""

    side: str
    amplitude_ma: float | None
    lower_ma: float | None
    upper_ma: float | None
    rate_hz: float | None
    pulse_width_us: float | None
    contacts: str
    sensing_hz: float | None


@dataclass(frozen=True)
class Group:
    """A therapy group as it was at a moment; `at` is None for the present groups of a report without a date."""

    at: datetime | None
    name: str
    active: bool
    programs: list[Program]


@dataclass(frozen=True)
class Marked:
    """An event: `patient` marked it, the `device` logged it, or it is an `annotation` or a `rating`, whose number is `value`."""

    at: datetime
    kind: str
    label: str
    value: float | None = None


@dataclass(frozen=True)
class History:
    """The history of one device as one report told it; what the report did not hold is empty. Battery: percent and months left."""

    recording: Recording
    trends: list[Trend]
    snapshots: list[Spectrum]
    surveys: list[Spectrum]
    groups: list[Group]
    events: list[Marked]
    battery_percent: float | None
    battery_months: float | None

    @property
    def notes(self) -> list[Marked]:
        """Annotations and ratings."""
        return [e for e in self.events if e.kind in ("annotation", "rating")]

    @property
    def patient_events(self) -> list[Marked]:
        """Those that the patient marked."""
        return [e for e in self.events if e.kind == "patient"]


def history_of(recording: Recording, hidden: Collection[date] = ()) -> History:
    """The history that a recording holds.

    Args:
        hidden: days of which neither trends nor programs are told, as any clock on earth has them: of visits whose plan's key is sealed.
    """
    kept = recording.details.get("settings", {})
    battery = kept.get("battery") or {}
    present = [_group(g, recording.started_at) for g in kept.get("groups") or []]
    before = [_group(g, _moment(visit["at"])) for visit in kept.get("group_history") or [] for g in visit["groups"]]
    return History(
        recording=recording,
        trends=[t for t in (_trend(side, stored, hidden) for side, stored in (kept.get("trends") or {}).items()) if t.unix_s],
        snapshots=[
            Spectrum(side, s["hz"], s["magnitude"], _moment(e["at"]), e["label"])
            for e in kept.get("snapshots") or []
            for side, s in e["spectra"].items()
        ],
        surveys=[
            Spectrum(m["side"], m["hz"], m["magnitude"], channel=m["channel"] or "", artifact=m["artifact"] or "")
            for m in kept.get("montage") or []
        ],
        groups=[g for g in (*before, *present) if g.at is None or not _within(g.at.timestamp(), hidden)],
        events=_events(recording),
        battery_percent=battery.get("percent"),
        battery_months=battery.get("months_left"),
    )


def _trend(side: str, stored: Mapping[str, Any], hidden: Collection[date]) -> Trend:
    rows = zip(stored["unix_s"], stored["power_device_units"], stored["amplitude_ma"], strict=True)
    told = [row for row in rows if not _within(row[0], hidden)]
    return Trend(side, [row[0] for row in told], [row[1] for row in told], [row[2] for row in told])


def _within(unix_s: float, days: Collection[date]) -> bool:
    at = datetime.fromtimestamp(unix_s, UTC)
    return bool(days) and any((at + shift).date() in days for shift in _CLOCKS)


def _group(stored: Mapping[str, Any], at: datetime | None) -> Group:
    sensed = {s["side"]: s["frequency_hz"] for s in stored.get("sensing") or []}
    names = ("side", "amplitude_ma", "lower_ma", "upper_ma", "rate_hz", "pulse_width_us", "contacts")
    programs = [Program(**{name: p[name] for name in names}, sensing_hz=sensed.get(p["side"])) for p in stored["programs"]]
    return Group(at, stored["group"] or "?", bool(stored["active"]), programs)


def _events(recording: Recording) -> list[Marked]:
    """In time order; the stored seconds count from the recording's start, or from its first event where it has none."""
    begin = recording.started_at
    if begin is None:
        return []
    stored = recording.details.get("events") or []
    return [Marked(begin + timedelta(seconds=float(e["t_s"])), e["kind"], e["label"], e["data"].get("value")) for e in stored]


def _moment(stored: str | None) -> datetime | None:
    return datetime.fromisoformat(stored) if stored else None
