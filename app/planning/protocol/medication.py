"""Medication due on a visit day: the participant's schedule next to the sessions of a plan, with which it is signed."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import time

from app.study.characteristics import PlannedDose
from app.study.doses import DRUGS


def due_before(lengths: Sequence[float], starts_at: time | None, schedule: Sequence[PlannedDose]) -> list[str]:
    """Describe what is due before each session and after the start of the one before it; empty where no time of day is planned.

    Args:
        lengths: minutes from each session's start to the next one's. starts_at: of the first, by the clinic's clock.
        schedule: doses of a visit day, by the same clock.
    """
    if starts_at is None:
        return [""] * len(lengths)
    found, since, begins = [], -1.0, 60.0 * starts_at.hour + starts_at.minute
    for length in lengths:
        due = [d for d in schedule if since < _minutes(d.at) <= begins]
        found.append("; ".join(f"{d.at} {DRUGS[d.drug].name} {d.mg:g} mg" for d in due))
        since, begins = begins, begins + length
    return found


def _minutes(at: str) -> int:
    hours, minutes = at.split(":")
    return 60 * int(hours) + int(minutes)
