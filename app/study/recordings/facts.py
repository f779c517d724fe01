"""Facts of a recording besides its traces: data quality per stream, the clinician's amplitude limits, its clock."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from pydantic import Field
from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload

from app.platform.numbers import stated
from app.platform.web.schemas import Model
from app.tables.recordings import Recording
from app.tables.sessions import StudySession
from app.tables.visits import Visit
from ml.formats import lead_in_words
from ml.formats.rejection import REJECTED_WORDS, Rejected

# API types of what a device keeps besides sessions.


class TrendOut(Model):
    """Averages over ten minutes of one side."""

    side: str
    unix_s: list[float] = Field(description="Times of the averages, Unix seconds.")
    power: list[float | None] = Field(description="Sensed power, device units.")
    amplitude_ma: list[float | None]


class DeviceSpectrumOut(Model):
    """A spectrum that the device made."""

    side: str | None
    at: datetime | None = Field(description="Of a snapshot; null of a survey.")
    label: str = Field(description="The patient's event, a known word or a number.")
    channel: str = Field(description="Contacts of a survey.")
    artifact: str = Field(description="What the device says of artefacts in a survey.")
    hz: list[float]
    magnitude: list[float] = Field(description="uVp, as the device gives it.")


class TherapyProgramOut(Model):
    """One side's program of a therapy group; null where the report does not say."""

    side: str
    amplitude_ma: float | None
    lower_ma: float | None
    upper_ma: float | None
    rate_hz: float | None
    pulse_width_us: float | None
    contacts: str
    sensing_hz: float | None


class TherapyGroupOut(Model):
    """A therapy group as it was at the end of a programming session."""

    at: datetime | None
    name: str
    active: bool
    programs: list[TherapyProgramOut]


class DeviceEventOut(Model):
    """An event that the patient marked or the device logged, an annotation or a symptom rating."""

    at: datetime
    kind: str = Field(description="patient, device, annotation or rating.")
    label: str = Field(description="Known words, or the event's number: other names and texts are not stored.")
    value: float | None = Field(description="Of a rating, 0 to 100 on the scale of the report; null of everything else.")


class DeviceHistoryOut(Model):
    """Device's own history in one report; what it does not hold is empty."""

    recording_id: int
    device: str = Field(description="Pseudonym of the device.")
    reported_at: datetime | None
    trends: list[TrendOut]
    snapshots: list[DeviceSpectrumOut]
    surveys: list[DeviceSpectrumOut]
    groups: list[TherapyGroupOut]
    events: list[DeviceEventOut]
    battery_percent: float | None
    battery_months: float | None


# Queries of what recordings contain besides their traces.


def histories(db: Session, participant_id: int) -> Sequence[Recording]:
    """Load reports of a participant's devices on their own history, the newest first."""
    query = select(Recording).options(joinedload(Recording.device)).where(Recording.participant_id == participant_id)
    query = query.where(Recording.details["settings"]["section"].astext == "history")
    return db.scalars(query.order_by(Recording.started_at.desc().nulls_last(), Recording.id.desc())).all()


def sealed_days(db: Session, participant_id: int) -> frozenset[dt.date]:
    """Return the days (UTC) of a participant's visits whose blinded plan's key is sealed, and the days of their sessions."""
    sealed = (Visit.participant_id == participant_id) & Visit.sealed
    dated = db.scalars(select(Visit.date).where(sealed, Visit.date.is_not(None)))
    began = db.scalars(select(StudySession.started_at).join(Visit).where(sealed, StudySession.started_at.is_not(None)))
    return frozenset([*(d for d in dated if d), *(at.astimezone(dt.UTC).date() for at in began if at)])


def with_battery(db: Session, participant_id: int) -> Sequence[Recording]:
    """Load recordings and reports with the charge or voltage of the stimulator's battery, the newest first."""
    query = select(Recording).options(joinedload(Recording.device)).where(Recording.participant_id == participant_id)
    query = query.where(Recording.details["settings"]["battery"].astext.is_not(None), Recording.superseded_by_id.is_(None))
    return db.scalars(query.order_by(Recording.started_at.desc().nulls_last(), Recording.id.desc())).all()


CLOCKS = {
    "pc": "clock of the PC that recorded (packet times)",
    "device": "clock of the device, which may be off local time",
    "table": "times of the table",
}


def unknown_clock(recording: Recording) -> bool:
    """Decide whether a start is on a clock of unknown offset from UTC, so that nothing of another clock can be joined to it."""
    stored = _clock(recording)
    return stored.get("known") is False


def clock_words(recording: Recording) -> str:
    """Describe what the times of a recording rest on."""
    stored = _clock(recording)
    if stored.get("known") is False:
        return f"{stored.get('name', 'device')}'s clock, whose offset from UTC is unknown: {stored.get('why', '')}"
    if stored.get("ahead_s") is None:
        return CLOCKS[recording.clock]
    by = f", stated by {stored['stated_by']}" if "stated_by" in stored else ""
    off = f"{lead_in_words(float(stored['ahead_s']))} UTC within {stored.get('uncertainty_s') or 0:g} s{by} ({stored.get('why', '')})"
    return f"{stored.get('name', 'device')}'s clock, which was {off}; corrected by that"


def _clock(recording: Recording) -> Mapping[str, Any]:
    stored = recording.details.get("settings", {}).get("clock")
    return stored if isinstance(stored, Mapping) else {}


_KNOWN = {
    *("packets", "samples", "missing", "missing_samples", "missing_s", "loss", "chunks", "rejected", "unusable", "clock", "loss_visible"),
    *("rate_hz", "paused_s", "reordered", "late", "moved"),
}
_APART = {"valid_fraction", "clock"}
"""Parts of the quality that are elsewhere on the page."""


@dataclass(frozen=True)
class StreamQuality:
    """One stream of a recording; None where its file does not say.

    Attributes:
        name: of the stream. what: whether `count` and `missing` are packets or samples.
        missing_s: signal that is missing, s. loss: its share of the signal, 0 to 1 (up to decode version 4: of packets).
        gaps: interruptions.
        late, out_of_order, duplicates: packets that arrived late, after a later one, or twice.
        clock: what placed it in time. remarks: everything else, in words.
    """

    name: str
    what: str
    count: int | None
    missing: int | None
    missing_s: float | None
    loss: float | None
    gaps: int | None
    late: int | None
    out_of_order: int | None
    duplicates: int
    clock: str
    remarks: list[str]


def quality_rows(recording: Recording) -> list[StreamQuality]:
    """List the data quality of each stream, in the order of the decoder."""
    rows = []
    for name, stored in recording.details.get("quality", {}).items():
        if not isinstance(stored, Mapping) or name in _APART or not _is_stream(stored):
            continue
        if _KNOWN & stored.keys():
            rows.append(_row(name, stored, recording.clock))
        else:
            rows += [_row(f"{name} {channel}", one, recording.clock) for channel, one in stored.items()]
    return rows


def quality_remarks(recording: Recording) -> list[tuple[str, str]]:
    """List remarks of the quality that belong to no stream: of what, and what."""
    quality = recording.details.get("quality", {})
    return [
        (_words(name), _plain(value))
        for name, value in quality.items()
        if value not in (None, {}) and name not in _APART and not (isinstance(value, Mapping) and _is_stream(value))
    ]


@dataclass(frozen=True)
class SensingConfiguration:
    """Sensing of the device from a moment of the recording on.

    Attributes:
        from_s: in the recording's seconds. channels: contacts and sampling rate of each channel. bands: of its own power, where on.
    """

    from_s: float
    channels: list[str]
    bands: list[str]


def sensing_configurations(recording: Recording) -> list[SensingConfiguration]:
    """List the changes of sensing within the recording; repetitions of the one before are ignored."""
    found: list[SensingConfiguration] = []
    for state in recording.details.get("settings", {}).get("sensing") or []:
        contacts = state.get("contacts") or []
        rates = state.get("rates_hz") or []
        pairs = zip(contacts, rates, strict=False)
        channels = [f"key {i}: {pair} at {rate:g} Hz" for i, (pair, rate) in enumerate(pairs) if isinstance(rate, int | float)]
        bands = [str(b) for b in state.get("bands") or [] if b] if int(state.get("sense_bits") or 0) & 4 else []
        one = SensingConfiguration(float(state.get("from_s") or 0.0), channels, bands)
        if not found or (found[-1].channels, found[-1].bands) != (channels, bands):
            found.append(one)
    # what was set before the recording's begin and replaced before it says nothing of it
    return [c for i, c in enumerate(found) if i + 1 == len(found) or found[i + 1].from_s > 0]


def adaptive_states(recording: Recording) -> list[tuple[float, int]]:
    """List changes of the adaptive state: time in the recording (s), state."""
    events = recording.details.get("events") or []
    return [(float(e["t_s"]), int(e["data"]["state"])) for e in events if e.get("kind") == "adaptive_state"]


def leads(recording: Recording) -> str:
    """Name the leads, as the device's settings state them."""
    return ", ".join(str(x) for x in recording.details.get("settings", {}).get("leads") or [] if x)


@dataclass(frozen=True)
class ClockFit:
    """Fit of the PC's clock against the implant's ticks, over one recording.

    Attributes:
        drift_ppm: how fast the implant's clock runs against the PC's; None where the recording is too short.
        pc_steps, implant_steps: where a clock was set: time in the recording, and by how much, s.
        residual_t_s, residual_ms: PacketGenTime minus the fitted clock, the extremes of pieces of the recording.
        sd_ms: of all residuals. beyond_50_ms: share of packets whose residual is larger than 50 ms.
    """

    drift_ppm: float | None
    pc_steps: list[tuple[float, float]]
    implant_steps: list[tuple[float, float]]
    residual_t_s: list[float]
    residual_ms: list[float]
    sd_ms: float | None
    beyond_50_ms: float | None


def clock_fit(recording: Recording) -> ClockFit | None:
    """Read the fit of the clocks; None for recordings without one (tables, Percept, decode versions up to 4)."""
    stored = recording.details.get("quality", {}).get("clock")
    if not isinstance(stored, Mapping):
        return None

    def steps(name: str) -> list[tuple[float, float]]:
        return [(float(t), float(by)) for t, by in stored.get(name) or []]

    return ClockFit(
        drift_ppm=stored.get("drift_ppm"),
        pc_steps=steps("pc_steps"),
        implant_steps=steps("implant_steps"),
        residual_t_s=[float(t) for t in stored.get("residual_t_s") or []],
        residual_ms=[float(ms) for ms in stored.get("residual_ms") or []],
        sd_ms=stored.get("residual_sd_ms"),
        beyond_50_ms=stored.get("residual_beyond_50_ms"),
    )


def valid_shares(recording: Recording) -> dict[str, float]:
    """Return the share of valid windows per trace over the whole recording, 0 to 1."""
    stored = recording.details.get("quality", {}).get("valid_fraction", {})
    return (
        {_words(name): float(value) for name, value in stored.items() if isinstance(value, int | float)}
        if isinstance(stored, Mapping)
        else {}
    )


def amplitude_limits(recording: Recording) -> list[tuple[str, str]]:
    """List the clinician's limits that the device stores: where, and from to in mA."""
    found = []
    for group, programs in (recording.details.get("limits") or {}).items():
        for program, limit in _limit_rows(programs):
            found.append((" ".join(w for w in (_words(group), program) if w), limit))
    return found


def _is_stream(stored: Mapping[str, Any]) -> bool:
    """Check whether a part of the quality is a stream's, or has one of these per channel."""
    return bool(_KNOWN & stored.keys()) or (bool(stored) and all(isinstance(v, Mapping) and _KNOWN & v.keys() for v in stored.values()))


def _limit_rows(stored: Any) -> list[tuple[str, str]]:
    if not isinstance(stored, Mapping):
        return [("", _plain(stored))]
    if "lower_ma" in stored or "upper_ma" in stored:
        return [("", f"{_ma(stored.get('lower_ma'))} to {_ma(stored.get('upper_ma'))} mA")]
    return [(" ".join(w for w in (_words(k), tail) if w), limit) for k, v in stored.items() for tail, limit in _limit_rows(v)]


def _row(name: str, stored: Mapping[str, Any], clock: str) -> StreamQuality:
    samples = "packets" not in stored and "samples" in stored
    rejected = {_rejected(why): int(count) for why, count in (stored.get("rejected") or {}).items()}
    twice = rejected.pop(Rejected.DUPLICATE, 0)
    remarks = [f"{count} left out: {REJECTED_WORDS[why]}" for why, count in rejected.items()]
    if stored.get("paused_s"):
        remarks.append(f"sensing switched off for {stored['paused_s']:.1f} s in between")
    if stored.get("moved"):
        remarks.append(f"{stored['moved']} under the clock of the next one put back before it")
    if stored.get("unusable"):
        remarks.append(f"{stored['unusable']} left out: fields missing or of the wrong kind")
    if stored.get("loss_visible") is False:
        remarks.append("the file gives no packet times: loss cannot be seen")
    if stored.get("rate_hz"):
        remarks.append(f"{_plain(stored['rate_hz'])} Hz")
    remarks += [
        f"{_SHOWN.get(key, _words(key))}: {_plain(value)}"
        for key, value in stored.items()
        if key not in _KNOWN and value not in (None, {}, [])
    ]
    unseen = stored.get("loss_visible") is False
    return StreamQuality(
        _words(name),
        "samples" if samples else "packets",
        stored.get("samples" if samples else "packets"),
        None if unseen else stored.get("missing_samples" if samples else "missing"),
        None if unseen else stored.get("missing_s"),
        None if unseen else stored.get("loss"),
        max(0, int(stored["chunks"]) - 1) if stored.get("chunks") is not None else None,
        stored.get("late"),
        stored.get("reordered"),
        twice,
        str(stored.get("clock", clock)),
        remarks,
    )


_SHOWN = {"latency_median_ms": "median latency (ms)", "flat_share": "share of samples that stand still"}
"""Names of further numbers of a stream that their own words do not explain."""


def _rejected(stored: str) -> Rejected:
    """Read why packets were rejected, as stored."""
    return Rejected(stored)


def _ma(value: Any) -> str:
    return f"{value:g}" if isinstance(value, int | float) else "?"


def _words(name: str) -> str:
    return str(name).replace("_", " ")


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{_words(k)} {_plain(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(_plain(v) for v in value[:12]) + (" …" if len(value) > 12 else "")
    return stated(value, 4) if isinstance(value, float) else str(value)
