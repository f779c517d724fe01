"""Queries of the evidence: which rows it rests on, in which version."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from sqlalchemy import cast, func, literal, select
from sqlalchemy.dialects.postgresql import JSONPATH
from sqlalchemy.orm import Session, contains_eager, defer, joinedload, selectinload

from app.tables.participants import Participant
from app.tables.recordings import Recording
from app.tables.sessions import SessionSegment, StudySession
from app.tables.visits import Visit

STIMULATION_EVENTS = '$.events[*] ? (@.kind == "stimulation")'


def sessions_of(db: Session, participant_ids: Collection[int]) -> dict[int, list[StudySession]]:
    """Sessions and proposals by participant, visit and order, to read many at once: without their conditions and recordings."""
    visit = contains_eager(StudySession.visit).options(
        joinedload(Visit.participant).joinedload(Participant.site), selectinload(Visit.locks), selectinload(Visit.cdbs_amplitudes)
    )
    query = (
        select(StudySession)
        .join(StudySession.visit)
        .where(Visit.participant_id.in_(participant_ids))
        .options(
            visit,
            selectinload(StudySession.qocs),
            selectinload(StudySession.segments),
        )
        .order_by(Visit.number, StudySession.ordinal)
        .execution_options(populate_existing=True)  # what was read before may be older than the key of what is kept
    )
    found: dict[int, list[StudySession]] = {}
    for session in db.scalars(query):
        found.setdefault(session.visit.participant_id, []).append(session)
    return found


def recordings(db: Session, recording_ids: Collection[int]) -> Sequence[Recording]:
    """Recordings without what they tell; while somebody holds them, segments find theirs without a query."""
    if not recording_ids:
        return []
    return db.scalars(select(Recording).where(Recording.id.in_(recording_ids)).options(defer(Recording.details))).all()


def stimulation_events(db: Session, recording_ids: Collection[int]) -> dict[int, list[dict[str, Any]]]:
    """Logged states of the stimulation by recording, in time order: `t_s` and `data` with `rate_hz` and `programs`."""
    events = func.jsonb_path_query_array(Recording.details, cast(literal(STIMULATION_EVENTS), JSONPATH))
    rows = db.execute(select(Recording.id, events).where(Recording.id.in_(recording_ids)))
    return {row[0]: sorted(row[1], key=lambda e: e.get("t_s") or 0.0) for row in rows}


def spans(db: Session, session_ids: Collection[int]) -> dict[tuple[int, int], tuple[float, float]]:
    """Where sessions lie in their recordings, s: by session and recording, from the first start to the last stop."""
    rows = db.execute(
        select(SessionSegment.session_id, SessionSegment.recording_id, func.min(SessionSegment.start_s), func.max(SessionSegment.stop_s))
        .where(SessionSegment.session_id.in_(session_ids))
        .group_by(SessionSegment.session_id, SessionSegment.recording_id)
    )
    return {(row[0], row[1]): (row[2], row[3]) for row in rows}
