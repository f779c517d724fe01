"""Stimulation programs as they were set while a session ran, and where those of two sessions differ."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from app.tables.participants import Hemisphere
from app.tables.recordings import Recording
from app.tables.sessions import StudySession

SAME_SHARE = 0.01
"""Rates and pulse widths within this share are one setting: devices count periods, so that 130 Hz is logged as 130.2 Hz."""


@dataclass(frozen=True)
class Program:
    """One program as set.

    Attributes:
        hemisphere, group: None where not known. program: its number. contacts: with their signs; empty where not known.
        pulse_width_us, rate_hz: None where not known.
    """

    hemisphere: str | None
    group: str | None
    program: int
    contacts: str = ""
    pulse_width_us: float | None = None
    rate_hz: float | None = None

    def as_json(self) -> dict[str, Any]:
        """For storage; `Program(**stored)` is the way back."""
        return asdict(self)


@dataclass(frozen=True)
class Difference:
    """One thing in which a program of a session is not that of another session; both in words with their unit."""

    hemisphere: str | None
    program: int
    of: str
    other: str


def of_session(session: StudySession) -> list[Program]:
    """Every program that stimulated during a session, of all its recordings; a program that was changed within it stands there twice."""
    found: dict[Program, None] = {}
    for segment in session.segments:
        side = segment.recording.hemisphere or (session.hemisphere if segment.is_control else None)
        found |= dict.fromkeys(_of_recording(segment.recording, side, segment.start_s, segment.stop_s))
    return list(found)


def stored(rows: Sequence[Mapping[str, Any]]) -> list[Program]:
    """Programs of a session's conditions."""
    return [Program(**row) for row in rows]


def differences(own: Iterable[Program], current: Iterable[Program], side: Hemisphere | None) -> list[Difference]:
    """In what a session's programs are not those that the participant has now.

    Compared are contacts, pulse width and rate of each program that both name, on the given side; what either does not know differs in
    nothing. Of a program that changed within a session, the last word counts as current, and every one of its own is compared.
    """
    now = {p.program: p for p in current if side is None or p.hemisphere in (None, side)}
    found: dict[Difference, None] = {}
    for program in own:
        other = now.get(program.program)
        if other is None or (side is not None and program.hemisphere not in (None, side)):
            continue
        for mine, theirs, unit in (
            (program.contacts, other.contacts, ""),
            (program.pulse_width_us, other.pulse_width_us, " us"),
            (program.rate_hz, other.rate_hz, " Hz"),
        ):
            if mine and theirs and not _same(mine, theirs):
                found[Difference(program.hemisphere, program.program, f"{_plain(mine)}{unit}", f"{_plain(theirs)}{unit}")] = None
    return list(found)


def _same(one: str | float, other: str | float) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return set(str(one).split()) == set(str(other).split())
    return abs(one - other) <= SAME_SHARE * max(one, other)


def _plain(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _of_recording(recording: Recording, side: str | None, start_s: float, stop_s: float) -> list[Program]:
    """Programs in force within a part of a recording, as its device's settings and stimulation log have them."""
    therapy = (recording.details.get("settings") or {}).get("therapy")
    if isinstance(therapy, Mapping):
        contacts, width, rate = (therapy.get(name) for name in ("contacts", "pulse_width_us", "rate_hz"))
        return [Program(side, therapy.get("group"), 0, contacts or "", width, rate)] if contacts or width or rate else []
    states = [e for e in recording.details.get("events") or [] if e.get("kind") == "stimulation"]
    before = [e for e in states if float(e["t_s"]) <= start_s]
    in_force = [*(before[-1:] or states[:1]), *(e for e in states if start_s < float(e["t_s"]) < stop_s)]
    return [
        Program(side, data.get("group"), int(p["program"]), p.get("contacts") or "", p.get("pulse_width_us"), data.get("rate_hz"))
        for data in (e.get("data") or {} for e in in_force)
        if data.get("therapy_on") is not False
        for p in data.get("programs") or []
    ]
