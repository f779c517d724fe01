"""Queries of sessions: which rows they are made of, in which version; what a request reads once; slots of plans; repeated minutes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property, lru_cache
from typing import Any

from sqlalchemy import (
    ARRAY,
    BindParameter,
    Float,
    Integer,
    Select,
    String,
    any_,
    bindparam,
    cast,
    func,
    literal,
    literal_column,
    or_,
    select,
    true,
    union_all,
)
from sqlalchemy.dialects.postgresql import aggregate_order_by
from sqlalchemy.orm import Session

from app.study.repository import CONFIRMED, sessions_of_participant
from app.tables.adverse_events import AdverseEvent, AdverseEventRevision
from app.tables.outcomes import QocRevision
from app.tables.participants import SettingsVersion
from app.tables.recordings import Recording, Trace
from app.tables.sessions import CountedTime, SessionConditions, SessionSegment, StudySession
from app.tables.visits import CdbsAmplitude, Dose, Visit
from ml.outcomes.records import Outcome


def fingerprints(db: Session, participant_ids: Collection[int]) -> dict[int, str]:
    """Hash, by participant, every row that its sessions are made of, each with the transaction that wrote its present version.

    PostgreSQL gives every version of a row such a number (`xmin`), so that any change of any column changes the hash.
    """
    found = dict.fromkeys(participant_ids, "")
    for owner, name, versions in db.execute(_row_versions(), {"participants": list(found)}):
        found[owner] += f"{name} {versions} "
    return found


@lru_cache(maxsize=1)
def _row_versions() -> Select[Any]:
    """Build the query of `fingerprints` once: to write it takes longer than to run it, and every page of results needs it."""
    visit, recording = Visit.participant_id, Recording.participant_id
    of_event = (AdverseEvent, AdverseEvent.id == AdverseEventRevision.event_id)
    parts = [
        _versions("visit", Visit.id, visit),
        _versions("settings_version", SettingsVersion.id, SettingsVersion.participant_id),
        _versions("cdbs_amplitude", CdbsAmplitude.id, visit, (Visit, Visit.id == CdbsAmplitude.visit_id)),
        _versions("dose", Dose.id, visit, (Visit, Visit.id == Dose.visit_id)),
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
        _versions("adverse_event_revision", AdverseEventRevision.id, AdverseEvent.participant_id, of_event),
    ]
    # one array: PostgreSQL takes 65 535 parameters at most
    asked: BindParameter[Any] = bindparam("participants", type_=ARRAY(Integer))
    rows = union_all(*(part.where(owner == any_(asked)) for part, owner in parts)).subquery()
    return select(rows).order_by(rows.c.name)


def _versions(name: str, key: Any, owner: Any, *joins: Any) -> tuple[Select[Any], Any]:
    """Hash the rows of one table by their participant; return the query and the column with the owner."""
    version = cast(key, String).op("||")(literal(":")).op("||")(cast(literal_column(f"{name}.xmin"), String))
    hashed = func.md5(func.string_agg(version, aggregate_order_by(literal(","), key, version)))
    query = select(owner.label("owner"), literal(name).label("name"), hashed).select_from(key.class_).group_by(owner)
    for join in joins:
        query = query.join(*join) if isinstance(join, tuple) else query.join(join)
    return query, owner


@dataclass
class ReadOnce:
    """Cache of a participant's confirmed sessions for several parts of one page; of one request."""

    db: Session
    participant_id: int

    @cached_property
    def fingerprint(self) -> str:
        """Changes with any row that the sessions are made of: for the key of what is kept of them, and to be asked before `rows`."""
        return fingerprints(self.db, [self.participant_id])[self.participant_id]

    @cached_property
    def rows(self) -> Sequence[StudySession]:
        """Sessions by visit and order, read again: what the transaction read before may be older than `fingerprint`."""
        return sessions_of_participant(self.db, self.participant_id, afresh=True)


def other_values(db: Session, session: StudySession, outcome: Outcome) -> list[float]:
    """Return the newest values of an outcome in the visit's other confirmed sessions that have one."""
    mine = (StudySession.visit_id == session.visit_id) & (StudySession.status == "confirmed") & (StudySession.id != session.id)
    value = getattr(QocRevision, outcome.field)
    revisions = select(QocRevision.session_id, value).join(StudySession, StudySession.id == QocRevision.session_id).where(mine)
    newest = {row[0]: row[1] for row in db.execute(revisions.order_by(QocRevision.revision))}
    return [float(found) for found in newest.values() if found is not None]


SLACK_S = 2.0
"""Two stretches of one device are the same minutes where they share more than this: clocks of consecutive recordings are not exact."""


@dataclass(frozen=True)
class SameMinutes:
    """A session that holds minutes of a device which another one holds too.

    Attributes:
        recording_id: its own recording of them. seconds: how long both are. counts: whether it is confirmed and not excluded.
    """

    session_id: int
    recording_id: int
    seconds: float
    counts: bool


def same_minutes(db: Session, recording: Recording, begin: datetime, end: datetime, besides: int | None) -> list[SameMinutes]:
    """Find sessions controlled by a recording's device and side within [begin, end], in another recording, by number.

    Args:
        recording: one of no known side is of both. besides: a session that is not asked for.
    """
    own_side = true() if recording.hemisphere is None else or_(Recording.hemisphere.is_(None), Recording.hemisphere == recording.hemisphere)
    first = Recording.started_at + func.make_interval(0, 0, 0, 0, 0, 0, SessionSegment.start_s)
    last = Recording.started_at + func.make_interval(0, 0, 0, 0, 0, 0, SessionSegment.stop_s)
    shared = func.extract("epoch", func.least(last, end) - func.greatest(first, begin))
    counts = CONFIRMED & StudySession.excluded_reason.is_(None)
    query = (
        select(StudySession.id, Recording.id, shared, counts)
        .join(SessionSegment, SessionSegment.session_id == StudySession.id)
        .join(Recording, Recording.id == SessionSegment.recording_id)
        .where(Recording.device_id == recording.device_id, Recording.id != recording.id, own_side, SessionSegment.is_control)
        # LEAST and GREATEST ignore NULL, so that a recording without a start would share all minutes
        .where(Recording.started_at.is_not(None), shared > SLACK_S, StudySession.id != (besides or 0))
        .order_by(StudySession.id)
    )
    return [SameMinutes(i, r, float(seconds), bool(counting)) for i, r, seconds, counting in db.execute(query)]


def policy_shares(db: Session, session_ids: Collection[int]) -> dict[int, float]:
    """Read the share of decisions that followed policy or schedule, by session with a log."""
    told = Recording.details["settings"]["controller"]
    query = (
        select(SessionSegment.session_id, cast(told["policy_share"].astext, Float))
        .join(Recording, Recording.id == SessionSegment.recording_id)
        .where(SessionSegment.session_id.in_(session_ids), SessionSegment.is_control)
        .where(told["purpose"].astext == "session", told["policy_share"].astext.is_not(None))
    )
    return {row[0]: row[1] for row in db.execute(query)}


def repeated_sessions(db: Session, participant_id: int) -> set[int]:
    """Find sessions that count by a device's clock and whose minutes in `counted_time` belong to an earlier session."""
    query = (
        select(StudySession.id)
        .join(StudySession.visit)
        .join(SessionSegment, SessionSegment.session_id == StudySession.id)
        .join(Recording, Recording.id == SessionSegment.recording_id)
        .outerjoin(CountedTime, (CountedTime.session_id == StudySession.id) & (CountedTime.recording_id == Recording.id))
        .where(Visit.participant_id == participant_id, CONFIRMED, StudySession.excluded_reason.is_(None), SessionSegment.is_control)
        .where(Recording.started_at.is_not(None), CountedTime.session_id.is_(None))
    )
    return set(db.scalars(query))
