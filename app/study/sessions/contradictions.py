"""Where what was said of a session (visit, controller, side, start) is not what its recordings tell; in sentences for a person."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta, timezone

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.platform.errors import Invalid
from app.study import blinding, repository
from app.study.models import Controller, Hemisphere, Recording, StudySession, Trace
from app.study.traces import AMPLITUDE_STREAM, StepTable, amplitude_program, shown_table, step_table

SILENT_MA = 0.005
"""Below this, an amplitude is off: devices step by 0.1 mA, tables are rounded."""
SILENT_FRACTION = 0.001
"""The same for amplitudes that are told as a fraction of the cDBS amplitude."""
CDBS_MEAN = (0.9, 1.1)
"""Between these, a mean amplitude fraction is that of cDBS."""
OFF_MEAN = 0.05
"""Above this mean fraction (or mean mA, where no cDBS amplitude is known), a session was not without DBS."""


@dataclass(frozen=True)
class Delivered:
    """What one recording of a session tells of the stimulation: one side, or one program of a side.

    Attributes:
        name: of the side, for a sentence. hemisphere: where it is known.
        is_control: whether its recording is the one that the controller saw.
        table: amplitudes on the session's grid; None where the recording tells none.
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
        """Whether every known amplitude is 0, and at least one is known."""
        amount, _, in_ma = self.inside
        known = amount[~np.isnan(amount)]
        return bool(known.size) and float(np.abs(known).max()) <= (SILENT_MA if in_ma else SILENT_FRACTION)

    @property
    def stimulated(self) -> bool:
        """Whether any known amplitude is not 0."""
        amount, _, _ = self.inside
        return bool(np.any(~np.isnan(amount))) and not self.silent


def delivered(db: Session, session: StudySession) -> list[Delivered]:
    """The stimulation of every side of a session, from all its recordings, the controlled one first.

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
        traces = [t for t in repository.traces_of_recording(db, recording.id) if t.stream == AMPLITUDE_STREAM]
        if not traces:
            found.append(Delivered(name, side, recording.id in control, None))
        for i, trace in enumerate(traces):
            table = shown_table(session, settings, trace, trace)
            own = f"{name}, {trace.channel}" if len(traces) > 1 else name
            if i and not _stated(session, side, trace):
                # the first program's cDBS amplitude says nothing about another program
                table = replace(table, fraction=np.full(table.t_s.size, np.nan), cdbs_ma=None)
            found.append(Delivered(own, side, recording.id in control, table))
    return found


def contradictions(db: Session, session: StudySession, visit_open: bool = False, steps_told: bool = False) -> list[str]:
    """Sentences where a session's recordings are not those of the controller, the side, the start and the visit it is said to have had.

    Args:
        visit_open: nobody has said the visit yet, so that its date contradicts nothing.
        steps_told: the reader is told elsewhere why steps cannot be read, and which lie above the cDBS amplitude.
    """
    found = [*_of_day(session, visit_open), *_of_start(session), *_of_side(session)]
    try:
        table = step_table(db, session, session.visit.participant.current_settings)
        sides = delivered(db, session)
    except Invalid as error:
        return found if steps_told else [str(error), *found]
    if table.above_one and not steps_told:
        steps = int(np.sum(table.t_s > 0))
        found.append(
            f"{table.above_one} of {steps} steps lie above the cDBS amplitude of {table.cdbs_ma or float('nan'):g} mA; "
            "they are kept as they are and stay out of replay buffers."
        )
    arm = blinding.stated_arm(session, SYSTEM)
    if arm is None:
        return found
    found += _of_controller(session, arm.controller, sides)
    if arm.controller in (Controller.RL, Controller.DISTILLED) and arm.policy_id is None:
        found.append("No policy is named for this session: it cannot be compared with its estimate. Name one on the session's page.")
    return found


def local_day(recording: Recording, moment: datetime) -> tuple[date, str]:
    """The day of a moment where the recording was made, by the offset that its file tells, else in UTC; and that offset, in words."""
    hours = recording.details.get("settings", {}).get("utc_offset_h")
    if isinstance(hours, int | float) and -14 <= hours <= 14:
        return moment.astimezone(timezone(timedelta(hours=hours))).date(), f" (UTC{hours:+g} h)" if hours else ""
    return moment.astimezone(UTC).date(), ""


def control_recording(session: StudySession) -> Recording:
    """The recording that the controller of a session saw."""
    return next(s for s in session.segments if s.is_control).recording


def _of_day(session: StudySession, visit_open: bool) -> Iterator[str]:
    visit = session.visit
    if visit_open or visit.date is None or session.started_at is None:
        return
    recording = control_recording(session)
    # where the stated start is wrong, the day of the recording is what the visit is held against
    day, clock = local_day(recording, recording.started_at or session.started_at)
    if visit.date not in (day, local_day(recording, session.started_at)[0]):
        yield f"Recorded on {day}{clock}, but visit {visit.number} is dated {visit.date}. Correct one of them."


def _of_start(session: StudySession) -> Iterator[str]:
    segment = next(s for s in session.segments if s.is_control)
    began = segment.recording.started_at
    if began is None or session.started_at is None:
        return
    by_clock = began + timedelta(seconds=segment.start_s)
    period = session.visit.participant.current_settings.period_s
    if abs((session.started_at - by_clock).total_seconds()) > period:
        yield (
            f"Said to start at {session.started_at:%Y-%m-%d %H:%M:%S} UTC, but by the recording's own clock this part of it starts at "
            f"{by_clock:%Y-%m-%d %H:%M:%S} UTC. Tremor minutes are found by the start."
        )


def _of_side(session: StudySession) -> Iterator[str]:
    recording = control_recording(session)
    if session.hemisphere and recording.hemisphere and session.hemisphere != recording.hemisphere:
        yield (
            f"Said to be controlled on the {session.hemisphere} side, but its control trace is of recording {recording.id}, which is of "
            f"the {recording.hemisphere} side. Correct the hemisphere, which also chooses the hand of the grasp test."
        )


def _of_controller(session: StudySession, controller: Controller, sides: Sequence[Delivered]) -> Iterator[str]:
    several = len(sides) > 1
    for side in sides:
        amount, fraction, _ = side.inside
        known, relative = amount[~np.isnan(amount)], fraction[~np.isnan(fraction)]
        if not known.size:
            continue
        of = f" on the {side.name}" if several else ""
        mean = float(relative.mean()) if relative.size else None
        share = f"{100 * mean:.0f} % of the cDBS amplitude" if mean is not None else f"{float(known.mean()):.3g} mA"
        if controller is Controller.CDBS and not _spared(session, side):
            outside = not CDBS_MEAN[0] <= mean <= CDBS_MEAN[1] if mean is not None else side.silent
            if outside:
                yield f"Said to be cDBS, but its mean amplitude{of} is {share}. Correct one of them."
        elif controller is Controller.NO_DBS:
            level = mean if mean is not None else float(known.mean())
            if level > OFF_MEAN:
                yield f"Said to be without DBS, but its mean amplitude{of} is {share}. Correct one of them."
        elif controller not in (Controller.CDBS, Controller.NO_DBS) and side.is_control and side.silent:
            others = [s.name for s in sides if s.stimulated]
            if others:
                yield (
                    f"The controlled {side.name} had no stimulation, while the {' and the '.join(others)} had: mean amplitude and energy "
                    "are those of the controlled side alone. Correct the hemisphere if the other one counts."
                )


def _spared(session: StudySession, side: Delivered) -> bool:
    """Whether a silent side is as the visit has it: cDBS amplitudes are stated for the other side alone."""
    stated = {a.hemisphere for a in session.visit.cdbs_amplitudes}
    return side.silent and bool(stated) and side.hemisphere is not None and side.hemisphere not in stated


def _side(session: StudySession, recording: Recording, is_control: bool) -> Hemisphere | None:
    return recording.hemisphere or (session.hemisphere if is_control else None)


def _stated(session: StudySession, side: Hemisphere | None, trace: Trace) -> bool:
    program = amplitude_program(trace)
    return any(a.program == program and side in (None, a.hemisphere) for a in session.visit.cdbs_amplitudes)
