"""Queries of the evidence: which rows it rests on, in which version."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import ColumnElement, Select, String, cast, func, literal, literal_column, select, union_all
from sqlalchemy.dialects.postgresql import JSONPATH
from sqlalchemy.orm import Session

from app.study.models import (
    CdbsAmplitude,
    QocRevision,
    Recording,
    SessionSegment,
    SettingsVersion,
    StudySession,
    Trace,
    Visit,
)

STIMULATION_EVENTS = '$.events[*] ? (@.kind == "stimulation")'


def fingerprint(db: Session, participant_id: int) -> str:
    """A hash over every row that a participant's evidence is made of, each with the transaction that wrote its present version.

    PostgreSQL gives every version of a row such a number (`xmin`), so that any change of any column changes the hash.
    """
    visits = select(Visit.id).where(Visit.participant_id == participant_id)
    sessions = select(StudySession.id).where(StudySession.visit_id.in_(visits))
    recordings = select(Recording.id).where(Recording.participant_id == participant_id)
    parts: list[Select[Any]] = [
        _versions("visit", Visit.id, Visit.participant_id == participant_id),
        _versions("settings_version", SettingsVersion.id, SettingsVersion.participant_id == participant_id),
        _versions("cdbs_amplitude", CdbsAmplitude.id, CdbsAmplitude.visit_id.in_(visits)),
        _versions("session", StudySession.id, StudySession.visit_id.in_(visits)),
        _versions("qoc", QocRevision.id, QocRevision.session_id.in_(sessions)),
        _versions("session_segment", SessionSegment.session_id, SessionSegment.session_id.in_(sessions)),
        _versions("recording", Recording.id, Recording.participant_id == participant_id),
        _versions("trace", Trace.id, Trace.recording_id.in_(recordings)),
    ]
    return "".join(db.scalars(union_all(*parts)))


def stimulation_events(db: Session, recording_ids: Collection[int]) -> dict[int, list[dict[str, Any]]]:
    """Logged states of the stimulation by recording, in time order: `t_s` and `data` with `rate_hz` and `programs`."""
    events = func.jsonb_path_query_array(Recording.details, cast(literal(STIMULATION_EVENTS), JSONPATH))
    rows = db.execute(select(Recording.id, events).where(Recording.id.in_(recording_ids)))
    return {row[0]: sorted(row[1], key=lambda e: e.get("t_s") or 0.0) for row in rows}


def _versions(name: str, key: Any, mine: ColumnElement[bool]) -> Select[Any]:
    version = cast(key, String).op("||")(literal(":")).op("||")(cast(literal_column(f"{name}.xmin"), String))
    return select(func.md5(func.coalesce(func.string_agg(version, literal(",")), literal("")))).select_from(key.class_).where(mine)


def spans(db: Session, session_ids: Collection[int]) -> dict[tuple[int, int], tuple[float, float]]:
    """Where sessions lie in their recordings, s: by session and recording, from the first start to the last stop."""
    rows = db.execute(
        select(SessionSegment.session_id, SessionSegment.recording_id, func.min(SessionSegment.start_s), func.max(SessionSegment.stop_s))
        .where(SessionSegment.session_id.in_(session_ids))
        .group_by(SessionSegment.session_id, SessionSegment.recording_id)
    )
    return {(row[0], row[1]): (row[2], row[3]) for row in rows}
