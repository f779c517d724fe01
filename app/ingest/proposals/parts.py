"""The part of its recordings that a proposal is: begin and end on the grid of steps, and the side that it was controlled on."""

from __future__ import annotations

from datetime import timedelta

from sqlalchemy.orm import Session

from app.ingest import sessions
from app.ingest.sessions import Placement, StatedSession, set_segments
from app.platform.errors import Invalid
from app.tables.sessions import StudySession


def choose_side(db: Session, session: StudySession, given: dict[str, object]) -> None:
    """Take the stated side; where a recording of that side belongs to the session, its trace is the one that the controller saw."""
    side = given["hemisphere"]
    session.hemisphere = side  # type: ignore[assignment]
    control = next(s for s in session.segments if s.is_control)
    other = next((s for s in session.segments if s.recording.hemisphere == side), None)
    if side is None or other is None or other.recording_id == control.recording_id:
        return
    placement = sessions.place(db, session.visit.participant, [other.recording], StatedSession(started_at=session.started_at), alone=True)
    placement.stop_s = min(placement.start_s + session.duration_s, placement.control.duration_s)
    placement.recordings = list(dict.fromkeys(s.recording for s in session.segments))
    session.control_stream, session.control_channel = placement.stream, placement.channel
    _move(session, placement)


def choose_part(session: StudySession, given: dict[str, object]) -> None:
    """Take the stated part of the control recording, or the stated start. Raises Invalid as `on_grid`."""
    control = next(s for s in session.segments if s.is_control)
    started_at = given.get("started_at")
    start_s, stop_s = given.get("start_s"), given.get("stop_s")
    begin = float(start_s) if isinstance(start_s, int | float) else control.start_s
    end = float(stop_s) if isinstance(stop_s, int | float) else control.stop_s
    if started_at is not None and control.recording.started_at is not None:
        begin = (started_at - control.recording.started_at).total_seconds()  # type: ignore[operator]
    placement = placement_of(session, *on_grid(session, begin, end))
    if control.recording.started_at is None and "started_at" in given:
        placement.started_at = started_at  # type: ignore[assignment]
    _move(session, placement)


def _move(session: StudySession, placement: Placement) -> None:
    set_segments(session, placement, session.visit.participant.current_settings.period_s)
    session.started_at, session.duration_s = placement.started_at, placement.stop_s - placement.start_s


def on_grid(session: StudySession, start_s: float, stop_s: float) -> tuple[float, float]:
    """Place a part of the control recording on the grid of steps. Raises Invalid where it is empty or outside the recording."""
    period = session.visit.participant.current_settings.period_s
    length = next(s for s in session.segments if s.is_control).recording.duration_s
    start, stop = round(start_s / period) * period, round(stop_s / period) * period
    if not 0 <= start < length or stop_s > length + period:
        raise Invalid(
            f"The recording is {length:.0f} s long; {start_s:.0f} to {stop_s:.0f} s is not within it.",
            "Choose a part of it.",
            field="stop_s" if start_s < length else "start_s",
        )
    # its end is the last row, whole or not: forms show it in whole seconds
    stop = length if stop_s > length - 1.0 and length - stop > 0.1 else min(stop, length)
    if stop - start < period:
        raise Invalid(
            f"The part from {start_s:.0f} to {stop_s:.0f} s holds no step of {period:g} s.", "Let it end after it begins.", field="stop_s"
        )
    return start, stop


def placement_of(session: StudySession, start_s: float, stop_s: float) -> Placement:
    """Place a session's recordings on another part of its control recording."""
    control = next(s for s in session.segments if s.is_control)
    recordings = list(dict.fromkeys(s.recording for s in session.segments))
    # a stated start may differ from the device's clock: the session's own start is what moves
    started_at = session.started_at + timedelta(seconds=start_s - control.start_s) if session.started_at is not None else None
    return Placement(control.recording, recordings, start_s, stop_s, started_at, session.control_stream, session.control_channel)
