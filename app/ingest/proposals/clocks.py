"""Clocks of recordings: recordings whose start was on a wrong clock move to their time, and their sessions with them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime, timedelta

from pydantic import Field
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.ingest import repository
from app.ingest.proposals import copies
from app.ingest.proposals import service as proposals
from app.ingest.proposals.parts import placement_of
from app.ingest.sessions import TOGETHER, set_segments
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.platform.web.schemas import Model, Number, Text
from app.study.access import require
from app.study.outcomes import service as outcomes
from app.study.sessions import conditions
from app.study.sessions.contradictions import control_recording
from app.study.visits import require_unlocked
from app.tables.recordings import Recording
from app.tables.sessions import StudySession
from ml.formats import RecordingLog, lead_in_words

LARGEST_S = 24 * 3600.0
"""A clock that is off by more than a day is a wrong date: state the start of its session instead."""
MOVED_S = 1.0
"""Starts that differ by less are the same: a Percept dates its packets to the second."""


class ClockIn(Model):
    """Offset of the clock of a session's recording from UTC, as a person knows it."""

    ahead_s: Number = Field(ge=-LARGEST_S, le=LARGEST_S, description="Seconds that the clock was ahead of UTC; negative where behind.")
    uncertainty_s: Number = Field(ge=0, le=LARGEST_S, description="Within which that is known, s.")
    reason: Text = Field(min_length=1, max_length=1000, description="What it rests on.")


class ClockOut(Model):
    """Result of a correction.

    `recordings`: numbers of those of its file and device, which have one clock. `said`: a sentence per session.
    """

    recordings: list[int]
    said: list[str]


def correct(db: Session, session: StudySession, offset: ClockIn, caller: Caller) -> ClockOut:
    """State the offset of the clock of a session's recording. All recordings of its file and device move, and their sessions with them.

    Raises:
        Conflict: as `move`. Invalid: its recording has no clock of its own.
    """
    require(caller, can.WRITE_STUDY, session.visit.participant)
    repository.lock_participant(db, session.visit.participant_id)
    control = control_recording(session)
    same = [control]
    if control.upload_file_id is not None:
        same = [r for r in repository.recordings_of_file(db, control.upload_file_id) if r.device_id == control.device_id]
    starts = {r: as_shown(r) - timedelta(seconds=offset.ahead_s) for r in same if r.started_at is not None}
    if control not in starts:
        what = f"Recording {control.id} names no time, so that it has no clock to correct."
        raise Invalid(what, "State the start of its session instead.")
    for recording in starts:
        settings = recording.details.get("settings", {})
        known = settings.get("clock") or {"name": recording.clock}
        stated = {
            "known": True,
            "ahead_s": offset.ahead_s,
            "ahead_at_end_s": offset.ahead_s,
            "uncertainty_s": offset.uncertainty_s,
            "why": offset.reason,
            "stated_by": caller.label,
            "showed": as_shown(recording).isoformat(),
        }
        recording.details = {**recording.details, "settings": {**settings, "clock": {**known, **stated}}}
    within = f"{lead_in_words(offset.ahead_s)} UTC within {offset.uncertainty_s:g} s"
    return ClockOut(recordings=sorted(r.id for r in starts), said=move(db, starts, caller.label, f"clock {within}: {offset.reason}"))


def as_shown(recording: Recording) -> datetime:
    """Compute when a recording began, as its own clock showed it."""
    assert recording.started_at is not None
    clock = recording.details.get("settings", {}).get("clock") or {}
    if isinstance(showed := clock.get("showed"), str):
        return datetime.fromisoformat(showed)
    return recording.started_at + timedelta(seconds=clock.get("ahead_s") or 0.0)


def keep_stated(recording: Recording, fresh: RecordingLog) -> RecordingLog:
    """Keep the clock that a person stated for a recording that is decoded again."""
    clock = recording.details.get("settings", {}).get("clock") or {}
    if "stated_by" not in clock or fresh.started_at is None:
        return fresh
    return replace(fresh, started_at=as_shown(recording) - timedelta(seconds=clock["ahead_s"]), settings={**fresh.settings, "clock": clock})


def move(
    db: Session, starts: Mapping[Recording, datetime], actor: str, why: str, is_final: Callable[[Recording], bool] = lambda _: True
) -> list[str]:
    """Put recordings at other starts. Each session moves with the recording that its controller saw, and keeps its rows of that.

    Args:
        starts: of each recording that moves, UTC. actor: name of who moves them. why: the reason, for the trail and the conditions.
        is_final: whether the start of another recording of such a session is final; where not, the session keeps its place in it.

    Returns:
        A sentence per session.

    Raises:
        Conflict: the visit of a session is locked, or its minutes would count twice.
    """
    sessions = {s.id: s for recording in starts for s in copies.sessions_of(db, recording)}
    for session in sessions.values():
        require_unlocked(session.visit)
    set_reason(db, why)
    old_starts = {number: session.started_at for number, session in sessions.items()}
    controls = {number: control_recording(session) for number, session in sessions.items()}
    old = {recording: recording.started_at for recording in starts}
    repository.defer_counting(db, True)
    for recording, began in starts.items():
        recording.started_at = began
    for number, session in sessions.items():
        control = controls[number]
        if control not in starts:
            continue
        first, was = next(s.start_s for s in session.segments if s.is_control), old[control]
        if was is not None and session.started_at is not None:
            session.started_at += starts[control] - was
        else:
            session.started_at = starts[control] + timedelta(seconds=first)
    db.flush()
    gone = {number: _realign(db, session, is_final) for number, session in sessions.items()}
    try:
        repository.defer_counting(db, False)
    except IntegrityError as error:
        what = "The recording would lie in minutes of its device that another confirmed session counts already."
        raise Conflict(what, "Exclude one of the two sessions with a reason, then try again.") from error
    said = []
    for number, session in sorted(sessions.items()):
        told = [_describe(session, old_starts[number]), *(f"recording {lost} does not share its time any more" for lost in gone[number])]
        if session.status == "confirmed":
            conditions.renew(db, session, actor, why)
            told += outcomes.derive_for_session(db, session)
        else:
            proposals.renew(db, session)
        said.append("; ".join(told))
    return said


def _describe(session: StudySession, old: datetime | None) -> str:
    name = f"session {session.id} (visit {session.visit.number})"
    if session.started_at is None or old is None:
        return f"{name}: starts {session.started_at:%Y-%m-%d %H:%M:%S} UTC" if session.started_at else f"{name}: start unknown"
    if session.started_at == old:
        return f"{name}: same start"
    by_s = (session.started_at - old).total_seconds()
    by = lead_in_words(abs(by_s)).removesuffix(" ahead of")
    return f"{name}: starts {session.started_at:%Y-%m-%d %H:%M:%S} UTC, {by} {'earlier' if by_s < 0 else 'later'} than before"


def _realign(db: Session, session: StudySession, is_final: Callable[[Recording], bool]) -> list[int]:
    """Give a session the same minutes in its other recordings as in the one that its controller saw.

    Returns:
        Numbers of recordings that share too little of its time to belong to it.
    """
    control = next(s for s in session.segments if s.is_control)
    recordings = {s.recording for s in session.segments}
    if len(recordings) == 1 or not all(is_final(r) for r in recordings):
        return []
    placement = placement_of(session, control.start_s, control.stop_s)
    placement.recordings = [r for r in placement.recordings if r is control.recording or _shares(session, r)]
    period_s = session.visit.participant.current_settings.period_s
    session.segments.clear()
    db.flush()  # parts that go are gone before the ones that come have the same keys
    set_segments(session, placement, period_s)
    db.flush()
    return sorted(r.id for r in recordings - {s.recording for s in session.segments})


def _shares(session: StudySession, recording: Recording) -> bool:
    """Decide whether a recording shares enough of a session's time; one without a start stays."""
    if recording.started_at is None or session.started_at is None:
        return True
    stop = session.started_at + timedelta(seconds=session.duration_s)
    end = min(stop, recording.started_at + timedelta(seconds=recording.duration_s))
    shared = (end - max(session.started_at, recording.started_at)).total_seconds()
    return shared >= TOGETHER * min(session.duration_s, recording.duration_s)
