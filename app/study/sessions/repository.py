"""Queries of sessions: which rows what they hold is made of, in which version; and which session of a plan they are."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

from sqlalchemy import Select, String, cast, column, func, literal, literal_column, select, table, union_all
from sqlalchemy.dialects.postgresql import aggregate_order_by
from sqlalchemy.orm import Session

from app.study.models import CdbsAmplitude, QocRevision, Recording, SessionSegment, SettingsVersion, StudySession, Trace, Visit
from app.study.sessions.models import SessionConditions


def fingerprints(db: Session, participant_ids: Collection[int]) -> dict[int, str]:
    """By participant: a hash over every row that its sessions are made of, each with the transaction that wrote its present version.

    PostgreSQL gives every version of a row such a number (`xmin`), so that any change of any column changes the hash.
    """
    visit, recording = Visit.participant_id, Recording.participant_id
    parts = [
        _versions("visit", Visit.id, visit),
        _versions("settings_version", SettingsVersion.id, SettingsVersion.participant_id),
        _versions("cdbs_amplitude", CdbsAmplitude.id, visit, (Visit, Visit.id == CdbsAmplitude.visit_id)),
        _versions("session", StudySession.id, visit, StudySession.visit),
        _versions("qoc", QocRevision.id, visit, QocRevision.session, StudySession.visit),
        _versions(
            "session_conditions",
            SessionConditions.id,
            visit,
            (StudySession, StudySession.id == SessionConditions.session_id),
            StudySession.visit,
        ),
        _versions("session_segment", SessionSegment.session_id, visit, SessionSegment.session, StudySession.visit),
        _versions("recording", Recording.id, recording),
        _versions("trace", Trace.id, recording, Trace.recording),
    ]
    found = dict.fromkeys(participant_ids, "")
    rows = union_all(*(part.where(owner.in_(found)) for part, owner in parts)).subquery()
    for owner, name, versions in db.execute(select(rows).order_by(rows.c.name)):
        found[owner] += f"{name} {versions} "
    return found


def _versions(name: str, key: Any, owner: Any, *joins: Any) -> tuple[Select[Any], Any]:
    """A hash over the rows of one table by their participant, and the column that says whose they are."""
    version = cast(key, String).op("||")(literal(":")).op("||")(cast(literal_column(f"{name}.xmin"), String))
    hashed = func.md5(func.string_agg(version, aggregate_order_by(literal(","), key, version)))
    query = select(owner.label("owner"), literal(name).label("name"), hashed).select_from(key.class_).group_by(owner)
    for join in joins:
        query = query.join(*join) if isinstance(join, tuple) else query.join(join)
    return query, owner


class SlotHead(NamedTuple):
    """One session of a plan as it stands: where it is, what it runs, and whether its plan is still signed (`plan_status` approved)."""

    slot_id: int
    plan_id: int
    plan_status: str
    visit_id: int
    position: int
    controller: str
    policy_id: int | None


def slot_head(db: Session, participant_id: int, slot_id: int) -> SlotHead | None:
    """A session of one of the participant's plans.

    Plans belong to a later phase; of their tables only these columns are needed here.
    """
    plans = table("plan", *(column(name) for name in ("id", "visit_id", "status")))
    items = table("plan_item", *(column(name) for name in ("id", "plan_id", "position", "controller", "policy_id")))
    wanted = (items.c.id, plans.c.id, plans.c.status, plans.c.visit_id, items.c.position, items.c.controller, items.c.policy_id)
    query = select(*wanted).join_from(items, plans, items.c.plan_id == plans.c.id).join(Visit, Visit.id == plans.c.visit_id)
    row = db.execute(query.where(items.c.id == slot_id, Visit.participant_id == participant_id)).first()
    return None if row is None else SlotHead(*row)


def other_ratings(db: Session, session: StudySession) -> list[float]:
    """The newest ratings of the visit's other confirmed sessions that have one."""
    mine = (StudySession.visit_id == session.visit_id) & (StudySession.status == "confirmed") & (StudySession.id != session.id)
    revisions = select(QocRevision.session_id, QocRevision.rating).join(StudySession, StudySession.id == QocRevision.session_id).where(mine)
    newest = {row.session_id: row.rating for row in db.execute(revisions.order_by(QocRevision.revision))}
    return [float(rating) for rating in newest.values() if rating is not None]
