"""Minutes of a device that several sessions claim: the same minutes count once."""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy.orm import Session

from app.platform.errors import Conflict
from app.study.sessions import repository
from app.study.sessions.repository import SameMinutes
from app.tables.sessions import SessionSegment, StudySession


def others(db: Session, session: StudySession) -> list[SameMinutes]:
    """Other sessions, proposed ones too, that are controlled by the same device and side in the same minutes, in another recording."""
    found: dict[int, SameMinutes] = {}
    for segment in session.segments:
        if segment.is_control and segment.recording.started_at is not None:
            for one in repository.same_minutes(db, segment.recording, *_span(segment), besides=session.id):
                found.setdefault(one.session_id, one)
    return list(found.values())


def counts_elsewhere(db: Session, session: StudySession) -> bool:
    """Whether a session that counts has the same minutes of the same device in another recording."""
    return any(one.counts for one in others(db, session))


def refuse(db: Session, session: StudySession) -> None:
    """Raises Conflict where a session that counts has the same minutes of the same device in another recording."""
    for one in others(db, session):
        if one.counts:
            mine = next(s.recording_id for s in session.segments if s.is_control)
            raise Conflict(
                f"Session {session.id} (recording {mine}) and session {one.session_id} (recording {one.recording_id}), which counts, "
                f"hold the same {one.seconds:.0f} s of one device, and what they hold differs: the same minutes count once.",
                f"Look at both. Drop this one, or exclude session {one.session_id} with a reason and confirm this one then.",
                sessions=[session.id, one.session_id],
                recordings=[mine, one.recording_id],
            )


def _span(segment: SessionSegment) -> tuple[datetime, datetime]:
    """Begin and end of a part of a recording that has a clock of its own."""
    began = segment.recording.started_at
    assert began is not None
    return began + timedelta(seconds=segment.start_s), began + timedelta(seconds=segment.stop_s)
