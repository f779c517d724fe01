"""What stimulators told of their batteries: read from the device, and no assumption."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy.orm import Session

from app.study.recordings import repository


@dataclass(frozen=True)
class Reading:
    """One reading; None for what the device does not tell.

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
    """Readings of a participant's stimulators, the newest first."""
    found = []
    for recording in repository.with_battery(db, participant_id):
        battery = recording.details["settings"]["battery"]
        device = f"{recording.device.kind.replace('_', ' ')} {recording.device.pseudonym}"
        values = (battery.get(name) for name in ("percent", "voltage_v", "months_left"))
        found.append(Reading(recording.id, recording.started_at, device, recording.hemisphere, *values))
    return found
