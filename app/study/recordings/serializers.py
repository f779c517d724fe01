"""The history of a device as an API type."""

from __future__ import annotations

from dataclasses import asdict

from app.study.recordings.history import History
from app.study.recordings.schemas import DeviceEventOut, DeviceHistoryOut, DeviceSpectrumOut, TherapyGroupOut, TrendOut


def history_out(history: History) -> DeviceHistoryOut:
    """Everything of one report."""
    return DeviceHistoryOut(
        recording_id=history.recording.id,
        device=history.recording.device.pseudonym,
        reported_at=history.recording.started_at,
        trends=[TrendOut(**asdict(t)) for t in history.trends],
        snapshots=[DeviceSpectrumOut(**asdict(s)) for s in history.snapshots],
        surveys=[DeviceSpectrumOut(**asdict(s)) for s in history.surveys],
        groups=[TherapyGroupOut.model_validate(asdict(g)) for g in history.groups],
        events=[DeviceEventOut(**asdict(e)) for e in history.events],
        battery_percent=history.battery_percent,
        battery_months=history.battery_months,
    )
