"""Data that a device keeps besides sessions: trends, snapshots and surveys of spectra, therapy groups and events; from a recording's
details.

Everything in it was reduced to numbers, times and known words before it was stored (`ml.formats.percept.details`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from app.study.recordings import facts
from app.study.recordings.controller_log import limits_and_policy, policy_share
from app.tables.recordings import Recording
from app.tables.sessions import Controller

# Readings of stimulators' batteries: from the device, no assumption.


@dataclass(frozen=True)
class Reading:
    """One reading; None for what the device does not report.

    Attributes:
        recording_id: the recording or report that holds it. at: its start. device: its kind and pseudonym. hemisphere: of the recording.
        percent: charge. voltage_v: V. months_left: as the device itself estimates them.
    """

    recording_id: int
    at: datetime | None
    device: str
    hemisphere: str | None
    percent: float | None
    voltage_v: float | None
    months_left: float | None


def readings(db: Session, participant_id: int) -> list[Reading]:
    """List readings of a participant's stimulators, the newest first."""
    found = []
    for recording in facts.with_battery(db, participant_id):
        battery = recording.details["settings"]["battery"]
        device = f"{recording.device.kind.replace('_', ' ')} {recording.device.pseudonym}"
        values = (battery.get(name) for name in ("percent", "voltage_v", "months_left"))
        found.append(Reading(recording.id, recording.started_at, device, recording.hemisphere, *values))
    return found


# What the tablet took for its decisions, and of its battery, by the logs of its controller: measured there, and uploaded with the log.

LEAST_FALL = 1.0
"""Charge, %, that must be used before the hours of a whole charge are estimated: operating systems report charge in whole per cent."""


@dataclass(frozen=True)
class Latency:
    """Time that one whole decision takes on the tablet, ms, as the paper's table has it.

    Attributes:
        mean, sd: over decisions. decisions: timed. sessions: with a log that has it.
    """

    mean: float
    sd: float
    decisions: int
    sessions: int = 1


@dataclass(frozen=True)
class Battery:
    """Charge of the tablet's own battery, %, at the first and the last row of a log that knows it, and the minutes between them."""

    first: float
    last: float
    minutes: float

    @property
    def hours_of_a_charge(self) -> float | None:
        """Hours of a whole charge if it went on falling as in this session; None where it hardly fell."""
        fall = self.first - self.last
        return self.minutes / 60 * 100 / fall if fall >= LEAST_FALL else None


@dataclass(frozen=True)
class Runtime:
    """One session on its tablet: time and battery, and the share of decisions by policy or schedule; None where the log does not say."""

    latency: Latency | None
    battery: Battery | None
    policy_share: float | None = None


def of_recording(recording: Recording) -> Runtime | None:
    """Read the tablet's time and battery from a controller's log; None for other recordings and for older logs without them."""
    said = limits_and_policy(recording)
    if said is None:
        return None
    timed, charge, minutes = said.get("latency_us"), said.get("tablet_battery_percent"), said.get("tablet_battery_minutes")
    latency = Latency(timed["mean"] / 1000, timed["std"] / 1000, int(timed["n"])) if timed else None
    battery = Battery(float(charge[0]), float(charge[1]), float(minutes)) if charge and minutes else None
    share = policy_share(recording)
    return Runtime(latency, battery, share) if latency or battery or share is not None else None


def by_controller(found: Iterable[tuple[Controller, Runtime | None]]) -> dict[Controller, Latency]:
    """Summarise latency by controller: mean of all timed decisions, and standard deviation within and between sessions."""
    each: Mapping[Controller, list[Latency]] = defaultdict(list)
    for controller, runtime in found:
        if runtime is not None and runtime.latency is not None:
            each[controller].append(runtime.latency)
    return {controller: _pooled(own) for controller, own in each.items()}


def _pooled(own: list[Latency]) -> Latency:
    n = np.array([one.decisions for one in own], dtype=np.float64)
    means, sds = np.array([one.mean for one in own]), np.array([one.sd for one in own])
    mean = float(np.sum(n * means) / n.sum())
    variance = float(np.sum(n * (sds**2 + (means - mean) ** 2)) / n.sum())
    return Latency(mean, variance**0.5, int(n.sum()), len(own))


_CLOCKS = (timedelta(hours=-12), timedelta(0), timedelta(hours=14))
"""The latest, the middle and the earliest clock on earth against UTC: a day is within what they call it."""


@dataclass(frozen=True)
class Trend:
    """Averages over ten minutes of one side: times (Unix s), power (device units) and amplitude (mA), all [n]; None where not reported."""

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
    """One side's program of a therapy group; None where not reported. `sensing_hz`: the frequency that the side was sensed at."""

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
    """The history of one device in one report; what the report did not hold is empty. Battery: percent and months left."""

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
    """Read the history that a recording holds.

    Args:
        hidden: days of which neither trends nor programs are shown, by any clock on earth has them: of visits whose plan's key is sealed.
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
    """List the events in time order; the stored seconds count from the recording's start, or from its first event where it has none."""
    begin = recording.started_at
    if begin is None:
        return []
    stored = recording.details.get("events") or []
    return [Marked(begin + timedelta(seconds=float(e["t_s"])), e["kind"], e["label"], e["data"].get("value")) for e in stored]


def _moment(stored: str | None) -> datetime | None:
    return datetime.fromisoformat(stored) if stored else None
