"""Design of a random session's amplitudes: by the visit's approved plan, as stated, or inferred from the amplitudes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.platform.errors import Conflict
from app.study import blinding, repository
from app.study.recordings import controller_log
from app.study.sessions import repository as session_rows
from app.study.sessions.repository import SameMinutes
from app.study.traces import StepTable
from app.tables.participants import Hemisphere
from app.tables.recordings import Recording
from app.tables.sessions import Controller, SessionConditions, SessionSegment, StudySession
from ml.designs import Hold, recognise, unstated_holds

Kind = Literal["paper", "stratified", "ladder", "near", "held", "unstated"]
"""Stated design. Without one, `held` for sustained amplitudes, else `unstated`, taken as the paper's."""

AGREEING_SHARE: Final = 0.9
"""A session followed a planned design as far as this share of its known steps has the planned amplitude."""
FEWEST_STEPS: Final = 30
"""Steps that must agree before a session counts as having followed a design."""
RESOLUTION_MA: Final = 0.1
"""What a stimulator rounds amplitudes to."""
ALIKE: Final = 0.02
"""Fractions closer than this are one amplitude where milliamperes are not known."""


@dataclass(frozen=True)
class Drawn:
    """Draws of a random session's amplitudes.

    Attributes:
        kind: by which design. level: of the session, fraction. seed: of the design.
        holds: decisions that last; empty where each step is one.
    """

    kind: Kind
    level: float | None
    seed: int | None
    holds: tuple[Hold, ...]

    @property
    def density_told(self) -> bool:
        """True where bound and holds give the density of each amplitude; false of stated sustained draws without holds."""
        return bool(self.holds) or self.kind in ("paper", "unstated")


def drawn(conditions: SessionConditions | None, table: StepTable) -> Drawn:
    """Find how the amplitudes of a random session were drawn, by its conditions, else by the amplitudes themselves.

    Args:
        conditions: of the session; None where nothing is known of them. table: its steps, and rows before it.
    """
    fraction = table.fraction[table.t_s > 0]
    if conditions is not None and conditions.design is not None:
        parameters: dict[str, Any] = conditions.design_parameters
        holds = tuple(Hold(h["start"], h["steps"], h["log_density"]) for h in parameters.get("holds", []))
        kind: Kind = conditions.design  # type: ignore[assignment]
        held = () if kind == "paper" else _until(holds, fraction.size) or _by_themselves(table)
        return Drawn(kind, parameters.get("level"), conditions.seed, held)
    found = _by_themselves(table)
    return Drawn("held" if found else "unstated", None, None, found)


def of_session(db: Session, session: StudySession, table: StepTable, caller: Caller) -> Drawn | None:
    """Find how a random session's amplitudes were drawn, also of a proposal that is not confirmed yet; None of another controller's.

    A proposal whose controller is open is read too: sustained amplitudes may show what it was.
    """
    arm = blinding.stated_arm(session, caller)
    if arm is not None and arm.controller is not Controller.RANDOM:
        return None
    if session.conditions is None and (plan := planned(db, session, table, session.visit.participant.current_settings.period_s)):
        parameters = plan["design_parameters"]
        holds = tuple(Hold(h["start"], h["steps"], h["log_density"]) for h in parameters["holds"])
        return Drawn(plan["design"], parameters["level"], plan["seed"], () if plan["design"] == "paper" else holds)
    found = drawn(session.conditions, table)
    return None if arm is None and len(found.holds) < 2 else found


def planned(db: Session, session: StudySession, table: StepTable, period_s: float) -> dict[str, Any] | None:
    """Return the design of this random session by its controller's log, else by the visit's approved plan, as members of its conditions.

    Without a log a session is compared with every designed session of the plan, and belongs to the one whose amplitudes it followed
    longest. Decisions after it left the design, such as a return to cDBS, are cut off. None where it followed none.

    Args:
        db: the session. session: whose visit. table: its steps. period_s: of these steps; designs of other steps are ignored.
    """
    if (drawn_by_log := controller_log.design_of_session(session)) is not None:
        return drawn_by_log
    fraction = table.fraction[table.t_s > 0]
    best: dict[str, Any] | None = None
    longest = FEWEST_STEPS - 1
    for design in repository.planned_designs(db, session.visit_id):
        if design["period_s"] != period_s:
            continue
        steps = followed(fraction, design["holds"], tolerance(table.cdbs_ma))
        if steps > longest:
            longest, best = steps, design
    if best is None:
        return None
    holds = [h for h in best["holds"] if h["start"] < longest]
    holds[-1] = holds[-1] | {"steps": min(holds[-1]["steps"], longest - holds[-1]["start"])}
    return {
        "design": best["design"],
        "seed": best["seed"],
        "lower_bound": best["lower_bound"],
        "design_parameters": {"level": best["level"], "holds": holds},
    }


def followed(fraction: NDArray[np.float64], holds: list[dict[str, Any]], within: float) -> int:
    """Count the steps from the start on over which the amplitudes are the planned ones in at least `AGREEING_SHARE` of those that are
    known.

    Args:
        fraction: of the session's steps, [T]; NaN where unknown. holds: planned. within: fractions closer than this agree.
    """
    wanted = np.repeat([h["amplitude"] for h in holds], [h["steps"] for h in holds])[: fraction.size]
    own = fraction[: wanted.size]
    known = np.isfinite(own)
    agrees = known & (np.abs(np.where(known, own, 0.0) - wanted) <= within)
    share = np.cumsum(agrees) / np.maximum(np.cumsum(known), 1)
    ends = np.flatnonzero(agrees & (share >= AGREEING_SHARE))
    return int(ends[-1]) + 1 if ends.size else 0


def tolerance(cdbs_ma: float | None) -> float:
    """Return the fraction below which two amplitudes are one after rounding to the device's resolution."""
    return max(ALIKE, RESOLUTION_MA / cdbs_ma) if cdbs_ma else ALIKE


def _by_themselves(table: StepTable) -> tuple[Hold, ...]:
    fraction = table.fraction[table.t_s > 0]
    return unstated_holds(recognise(fraction, tolerance(table.cdbs_ma) / 2), fraction.size)


def _until(holds: tuple[Hold, ...], steps: int) -> tuple[Hold, ...]:
    """Cut the holds of a session that ended after so many steps."""
    return tuple(Hold(h.start, min(h.steps, steps - h.start), h.log_density) for h in holds if h.start < steps)


# Stimulation programs as they were set while a session ran, and where those of two sessions differ.

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
        """Convert for storage; `Program(**stored)` is the inverse."""
        return asdict(self)


@dataclass(frozen=True)
class Difference:
    """One thing in which a program of a session is not that of another session; both in words with their unit."""

    hemisphere: str | None
    program: int
    of: str
    other: str


def programs_of_session(session: StudySession) -> list[Program]:
    """List every program that stimulated during a session, of all its recordings; a program that was changed within it is listed twice."""
    found: dict[Program, None] = {}
    for segment in session.segments:
        side = segment.recording.hemisphere or (session.hemisphere if segment.is_control else None)
        found |= dict.fromkeys(_of_recording(segment.recording, side, segment.start_s, segment.stop_s))
    return list(found)


def stored(rows: Sequence[Mapping[str, Any]]) -> list[Program]:
    """Read programs of a session's conditions."""
    return [Program(**row) for row in rows]


def differences(own: Iterable[Program], current: Iterable[Program], side: Hemisphere | None) -> list[Difference]:
    """List the differences between a session's programs and those that the participant has now.

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
    """List programs in force within a part of a recording, as its device's settings and stimulation log have them."""
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


# Minutes of a device that several sessions claim: the same minutes count once.


def others(db: Session, session: StudySession) -> list[SameMinutes]:
    """Find other sessions, proposed ones too, that are controlled by the same device and side in the same minutes, in another recording."""
    found: dict[int, SameMinutes] = {}
    for segment in session.segments:
        if segment.is_control and segment.recording.started_at is not None:
            for one in session_rows.same_minutes(db, segment.recording, *_span(segment), besides=session.id):
                found.setdefault(one.session_id, one)
    return list(found.values())


def counts_elsewhere(db: Session, session: StudySession) -> bool:
    """Check whether a session that counts has the same minutes of the same device in another recording."""
    return any(one.counts for one in others(db, session))


def refuse(db: Session, session: StudySession) -> None:
    """Raise Conflict where a session that counts has the same minutes of the same device in another recording."""
    for one in others(db, session):
        if one.counts:
            mine = next(s.recording_id for s in session.segments if s.is_control)
            raise Conflict(
                f"Session {session.id} (recording {mine}) and session {one.session_id} (recording {one.recording_id}), which counts, "
                f"hold the same {one.seconds:.0f} s of one device. Their contents differ: the same minutes count once.",
                f"Look at both. Drop this one, or exclude session {one.session_id} with a reason and confirm this one then.",
                sessions=[session.id, one.session_id],
                recordings=[mine, one.recording_id],
            )


def _span(segment: SessionSegment) -> tuple[datetime, datetime]:
    """Begin and end of a part of a recording that has a clock of its own."""
    began = segment.recording.started_at
    assert began is not None
    return began + timedelta(seconds=segment.start_s), began + timedelta(seconds=segment.stop_s)
