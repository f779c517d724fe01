"""Stimulation in the recordings of a session, and the controllers that such an amplitude can and cannot have come from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.study import repository
from app.study.traces import AMPLITUDE_STREAM, StepTable, TracesOf, amplitude_program, driving, shown_table
from app.tables.participants import Hemisphere
from app.tables.recordings import Recording, Trace
from app.tables.sessions import Controller, StudySession

SILENT_MA = 0.005
"""Below this, an amplitude is off: devices step by 0.1 mA, tables are rounded."""
SILENT_FRACTION = 0.001
"""The same for amplitudes that are given as a fraction of the cDBS amplitude."""
MEAN_FRACTION = {Controller.CDBS: (0.9, 1.1), Controller.NO_DBS: (0.0, 0.05)}
"""Mean amplitude fractions that a session of a controller with a fixed amplitude can have (ours)."""
OFF_MEAN = MEAN_FRACTION[Controller.NO_DBS][1]
"""Above this mean mA, where no cDBS amplitude is known, a session was not without DBS."""
CDBS_TOLERANCE = 0.05
"""A constant amplitude within this share of the cDBS amplitude is taken for cDBS."""
KNOWN_SHARE = 0.5
"""Share of a session's steps whose amplitude must be known before anything is guessed from it."""


@dataclass(frozen=True)
class Delivered:
    """Stimulation in one recording of a session: one side, or one program of a side.

    Attributes:
        name: of the side, for a sentence. hemisphere: where it is known.
        is_control: whether its amplitude is the one that the controller set.
        table: amplitudes on the session's grid; None where the recording holds none.
    """

    name: str
    hemisphere: Hemisphere | None
    is_control: bool
    table: StepTable | None

    @property
    def inside(self) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
        """Amount and fraction of the session's own steps, both shape [n], NaN where unknown; whether the amount is mA, else a fraction."""
        if self.table is None:
            return np.full(0, np.nan), np.full(0, np.nan), True
        rows = self.table.t_s > 0
        fraction, milliamperes = self.table.fraction[rows], self.table.amplitude_ma[rows]
        in_ma = bool(np.any(~np.isnan(milliamperes)))
        return (milliamperes if in_ma else fraction), fraction, in_ma

    @property
    def silent(self) -> bool:
        """True where every known amplitude is 0, and at least one is known."""
        amount, _, in_ma = self.inside
        known = amount[~np.isnan(amount)]
        return bool(known.size) and float(np.abs(known).max()) <= (SILENT_MA if in_ma else SILENT_FRACTION)

    @property
    def stimulated(self) -> bool:
        """True where any known amplitude is not 0."""
        amount, _, _ = self.inside
        return bool(np.any(~np.isnan(amount))) and not self.silent

    @property
    def moved(self) -> bool:
        """True where the known amplitude changed."""
        amount, _, in_ma = self.inside
        known = amount[~np.isnan(amount)]
        return bool(known.size) and float(np.ptp(known)) > (SILENT_MA if in_ma else SILENT_FRACTION)


class Pattern(StrEnum):
    """Pattern of the amplitude of one side over a session."""

    UNKNOWN = "unknown"
    MOSTLY_UNKNOWN = "mostly_unknown"
    OFF = "off"
    AT_CDBS = "at_cdbs"
    VARIES = "varies"
    CONSTANT_WITHOUT_CDBS = "constant_without_cdbs"
    CONSTANT = "constant"


GUESSES = {Pattern.OFF: Controller.NO_DBS, Pattern.AT_CDBS: Controller.CDBS}
"""The controller that a pattern speaks for; the others leave it open."""


@dataclass(frozen=True)
class Course:
    """The amplitude of one side over a session's steps.

    Attributes:
        side: its name.
        known, steps: steps whose amplitude is known, and all.
        low, high, median: of the known ones, in `unit` ("mA", or "% of cDBS" where the source gives fractions).
        cdbs_ma: the cDBS amplitude in force, mA. share: median fraction of it, in per cent; both None where none is stated.
    """

    side: str
    pattern: Pattern
    known: int = 0
    steps: int = 0
    low: float | None = None
    high: float | None = None
    median: float | None = None
    unit: str = "mA"
    cdbs_ma: float | None = None
    share: float | None = None

    @property
    def controller(self) -> Controller | None:
        """The controller that it speaks for, if any."""
        return GUESSES.get(self.pattern)

    def as_json(self) -> dict[str, Any]:
        """Convert for storage; `Course(**stored)` with its pattern is the inverse."""
        return asdict(self)


def course(side: Delivered) -> Course:
    """Describe the course of the amplitude of a side."""
    amount, fraction, in_ma = side.inside
    scale, unit = (1.0, "mA") if in_ma else (100.0, "% of cDBS")
    known = scale * amount[~np.isnan(amount)]
    if known.size == 0:
        return Course(side.name, Pattern.UNKNOWN, 0, amount.size)
    if known.size < KNOWN_SHARE * amount.size:
        return Course(side.name, Pattern.MOSTLY_UNKNOWN, known.size, amount.size)
    relative = fraction[~np.isnan(fraction)]
    return Course(
        side.name,
        _pattern(side, known, relative),
        known.size,
        amount.size,
        float(known.min()),
        float(known.max()),
        float(np.median(known)),
        unit,
        side.table.cdbs_ma if side.table else None,
        100 * float(np.median(relative)) if relative.size else None,
    )


def _pattern(side: Delivered, known: NDArray[np.float64], relative: NDArray[np.float64]) -> Pattern:
    if side.silent:
        return Pattern.OFF
    if relative.size and np.all(np.abs(relative - 1) <= CDBS_TOLERANCE + 1e-6):
        return Pattern.AT_CDBS
    middle = float(np.median(known))
    if not np.all(np.abs(known - middle) <= CDBS_TOLERANCE * middle):
        return Pattern.VARIES
    return Pattern.CONSTANT if relative.size else Pattern.CONSTANT_WITHOUT_CDBS


def fits(controller: Controller, mean_fraction: float) -> bool:
    """Check whether a session of this controller can have this mean amplitude fraction."""
    low, high = MEAN_FRACTION.get(controller, (-np.inf, np.inf))
    return bool(low <= mean_fraction <= high)


def contradicts(session: StudySession, controller: Controller, side: Delivered) -> bool:
    """Check whether the amplitude of a side cannot have come from this controller; False where too little is known."""
    amount, fraction, _ = side.inside
    known, relative = amount[~np.isnan(amount)], fraction[~np.isnan(fraction)]
    if not known.size:
        return False
    if controller is Controller.CDBS:
        if _spared(session, side):
            return False
        return not fits(controller, float(relative.mean())) if relative.size else side.silent
    if controller is Controller.NO_DBS:
        return (float(relative.mean()) if relative.size else float(known.mean())) > OFF_MEAN
    return False


def delivered(db: Session, session: StudySession) -> list[Delivered]:
    """Collect the stimulation of every side of a session, the controlled one first; errors as in `delivered_by`."""
    return delivered_by(session, lambda recording_id: repository.traces_of_recording(db, recording_id))


def beside(sides: Sequence[Delivered], counted: Trace | None) -> list[str]:
    """Name the sides and programs that stimulated, but for the one whose amplitude trace a session's step table was read from."""
    traces = ((s, s.table.amplitude_trace) for s in sides if s.table is not None and s.stimulated)
    return [s.name for s, trace in traces if trace is not None and (counted is None or trace.id != counted.id)]


def delivered_by(session: StudySession, traces_of: TracesOf) -> list[Delivered]:
    """Collect the stimulation of every side of a session from traces that are already loaded.

    Raises:
        Invalid: amplitudes that are not on the participant's grid, or a visit that states both sides and a session that names none.
    """
    settings = session.visit.participant.current_settings
    control = {s.recording_id for s in session.segments if s.is_control}
    recordings = sorted(dict.fromkeys(s.recording for s in session.segments), key=lambda r: (r.id not in control, r.id))
    sides = Counter(_side(session, r, r.id in control) for r in recordings)
    found = []
    for recording in recordings:
        side = _side(session, recording, recording.id in control)
        name = f"{side} side" if side else f"recording {recording.id}"
        if side and sides[side] > 1:
            name += f", recording {recording.id}"
        every = traces_of(recording.id)
        controlled = driving(session, every) if recording.id in control else None
        traces = sorted((t for t in every if t.stream == AMPLITUDE_STREAM), key=lambda t: t is not controlled)
        if not traces:
            found.append(Delivered(name, side, recording.id in control, None))
        for i, trace in enumerate(traces):
            table = shown_table(session, settings, trace, trace, recording, alone=len(traces) == 1)
            own = f"{name}, {trace.channel}" if len(traces) > 1 else name
            if i and not _stated(session, side, trace):
                # the first program's cDBS amplitude says nothing about another program
                table = replace(table, fraction=np.full(table.t_s.size, np.nan), cdbs_ma=None)
            found.append(Delivered(own, side, trace is controlled, table))
    return found


def _spared(session: StudySession, side: Delivered) -> bool:
    """Check whether a silent side agrees with the visit: cDBS amplitudes are stated only for the other side."""
    stated = {a.hemisphere for a in session.visit.cdbs_amplitudes}
    return side.silent and bool(stated) and side.hemisphere is not None and side.hemisphere not in stated


def _side(session: StudySession, recording: Recording, is_control: bool) -> Hemisphere | None:
    return recording.hemisphere or (session.hemisphere if is_control else None)


def _stated(session: StudySession, side: Hemisphere | None, trace: Trace) -> bool:
    program = amplitude_program(trace)
    return any(a.program == program and side in (None, a.hemisphere) for a in session.visit.cdbs_amplitudes)


def open_questions(session: StudySession) -> int:
    """Count the markers and channels that leave amplitudes of a session unknown until a person explains them."""
    recordings = {s.recording.id: s.recording for s in session.segments}.values()
    keys = {q["key"] for r in recordings for q in r.details.get("quality", {}).get("questions", ()) if q["asked"]}
    return len(keys)


def has_markers(session: StudySession) -> bool:
    """Decide whether recordings of a session have markers whose meaning a lab may state."""
    quality = [s.recording.details.get("quality", {}) for s in session.segments]
    return any(q.get("questions") or q.get("meanings") for q in quality)
