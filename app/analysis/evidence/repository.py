"""Queries of the evidence: which rows it rests on, in which version."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import Select, String, cast, func, literal, literal_column, select, union_all
from sqlalchemy.dialects.postgresql import JSONPATH, aggregate_order_by
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


def fingerprints(db: Session, participant_ids: Collection[int]) -> dict[int, str]:
    """By participant: a hash over every row that its evidence is made of, each with the transaction that wrote its present version.

    PostgreSQL gives every version of a row such a number (`xmin`), so that any change of any column changes the hash.
    """
    visit, recording = Visit.participant_id, Recording.participant_id
    parts = [
        _versions("visit", Visit.id, visit),
        _versions("settings_version", SettingsVersion.id, SettingsVersion.participant_id),
        _versions("cdbs_amplitude", CdbsAmplitude.id, visit, (Visit, Visit.id == CdbsAmplitude.visit_id)),
        _versions("session", StudySession.id, visit, StudySession.visit),
        _versions("qoc", QocRevision.id, visit, QocRevision.session, StudySession.visit),
        _versions("session_segment", SessionSegment.session_id, visit, SessionSegment.session, StudySession.visit),
        _versions("recording", Recording.id, recording),
        _versions("trace", Trace.id, recording, Trace.recording),
    ]
    found = dict.fromkeys(participant_ids, "")
    rows = union_all(*(part.where(owner.in_(found)) for part, owner in parts)).subquery()
    for owner, name, versions in db.execute(select(rows).order_by(rows.c.name)):
        found[owner] += f"{name} {versions} "
    return found


def stimulation_events(db: Session, recording_ids: Collection[int]) -> dict[int, list[dict[str, Any]]]:
    """Logged states of the stimulation by recording, in time order: `t_s` and `data` with `rate_hz` and `programs`."""
    events = func.jsonb_path_query_array(Recording.details, cast(literal(STIMULATION_EVENTS), JSONPATH))
    rows = db.execute(select(Recording.id, events).where(Recording.id.in_(recording_ids)))
    return {row[0]: sorted(row[1], key=lambda e: e.get("t_s") or 0.0) for row in rows}


def _versions(name: str, key: Any, owner: Any, *joins: Any) -> tuple[Select[Any], Any]:
    """A hash over the rows of one table by their participant, and the column that says whose they are."""
    version = cast(key, String).op("||")(literal(":")).op("||")(cast(literal_column(f"{name}.xmin"), String))
    hashed = func.md5(func.string_agg(version, aggregate_order_by(literal(","), key, version)))
    query = select(owner.label("owner"), literal(name).label("name"), hashed).select_from(key.class_).group_by(owner)
    for join in joins:
        query = query.join(*join) if isinstance(join, tuple) else query.join(join)
    return query, owner


def spans(db: Session, session_ids: Collection[int]) -> dict[tuple[int, int], tuple[float, float]]:
    """Where sessions lie in their recordings, s: by session and recording, from the first start to the last stop."""
    rows = db.execute(
        select(SessionSegment.session_id, SessionSegment.recording_id, func.min(SessionSegment.start_s), func.max(SessionSegment.stop_s))
        .where(SessionSegment.session_id.in_(session_ids))
        .group_by(SessionSegment.session_id, SessionSegment.recording_id)
    )
    return {(row[0], row[1]): (row[2], row[3]) for row in rows}
