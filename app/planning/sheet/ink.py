"""Colours and times of the printed sheet, and names as its fonts can spell them."""

from __future__ import annotations

from datetime import datetime, time, timedelta

from app.planning.plans.view import PlanLine
from app.planning.sheet.latin1_text import latin
from app.tables.learning import Policy
from app.tables.sessions import Controller

INK, MUTED, LINE = (20, 30, 38), (95, 108, 118), (150, 160, 168)
_PLANNED = (246, 248, 250)
_SHADES = {
    Controller.CDBS: (210, 228, 242),
    Controller.RL: (250, 221, 199),
    Controller.DISTILLED: (240, 214, 234),
    Controller.NO_DBS: (226, 229, 232),
    Controller.RANDOM: (207, 236, 226),
    Controller.OTHER: (240, 232, 200),
}


def shade(line: PlanLine) -> tuple[int, int, int]:
    """Colour of a session's controller; of none while the key is sealed."""
    return _SHADES[Controller(line.item.controller)] if line.item.controller else _PLANNED


def printed_name(policy: Policy) -> str:
    """A policy's name as the fonts can spell it, with its number where that is not the name itself: two policies never look alike."""
    printed = latin(policy.name)
    return printed if printed == policy.name else f"{printed} (#{policy.id})"


def printed_warning(text: str, policy: Policy | None) -> str:
    """A warning with its policy's name as the fonts can spell it."""
    return text.replace(f"'{policy.name}'", f"'{printed_name(policy)}'") if policy else text


def clock(minutes: float, starts_at: time | None) -> str:
    """When something is due, `minutes` after the first session's start: by the clinic's clock, else h:mm from that start."""
    if starts_at is None:
        return f"{round(minutes) // 60}:{round(minutes) % 60:02d}"
    return f"{datetime.combine(datetime.min, starts_at) + timedelta(minutes=round(minutes)):%H:%M}"
