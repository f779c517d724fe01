"""API types of what a device keeps beside sessions."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from app.platform.web.schemas import Model


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
    """One side's program of a therapy group; null where the report does not tell."""

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
    """What one report tells of its device's own history; what it does not hold is empty."""

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
