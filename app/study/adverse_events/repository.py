"""Queries of adverse events, within what the caller may read."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sqlalchemy import Select, String, cast, select
from sqlalchemy.orm import Session, joinedload, selectinload

from app.accounts.permissions import Caller
from app.platform.errors import NotFound
from app.study.repository import in_scope
from app.tables.adverse_events import AdverseEvent, AdverseEventRevision, EventKind
from app.tables.participants import Participant
from app.tables.plans import DayEntry
from app.tables.sessions import StudySession
from app.tables.visits import Visit


def event(db: Session, event_id: int, caller: Caller) -> AdverseEvent:
    """An event. Raises NotFound."""
    query = _events().join(AdverseEvent.participant).join(Participant.site).where(AdverseEvent.id == event_id, in_scope(caller))
    row = db.scalar(query)
    if row is None:
        raise NotFound(f"There is no adverse event {event_id}, or you have no access to it.")
    return row


def events_of_participant(db: Session, participant_id: int) -> Sequence[AdverseEvent]:
    """A participant's events in the order in which they were entered."""
    return db.scalars(_events().where(AdverseEvent.participant_id == participant_id).order_by(AdverseEvent.id)).all()


def with_blocking_events(db: Session) -> Sequence[Participant]:
    """Return the participants of this installation with a serious event or a stop, cleared or not."""
    blocking = AdverseEventRevision.serious | (AdverseEventRevision.kind == EventKind.STOPPED)
    serious = select(AdverseEvent.participant_id).join(AdverseEvent.revisions).where(blocking)
    return db.scalars(select(Participant).where(Participant.id.in_(serious)).order_by(Participant.id)).all()


def events_of_session(db: Session, session_id: int) -> Sequence[AdverseEvent]:
    """The events of a session in the order in which they were entered."""
    return db.scalars(_events().where(AdverseEvent.session_id == session_id).order_by(AdverseEvent.id)).all()


def stops_of_session(db: Session, session: StudySession) -> Sequence[AdverseEvent]:
    """Return the stops of a session, and those that the clinic day has of its place in the plan, in the order of their entry."""
    of_place = select(cast(DayEntry.uuid, String)).where(DayEntry.plan_item_id == session.plan_item_id, DayEntry.kind == "stop_cause")
    mine = (AdverseEvent.session_id == session.id) | AdverseEvent.entry_key.in_(of_place)
    found = db.scalars(_events().where(AdverseEvent.participant_id == session.visit.participant_id, mine).order_by(AdverseEvent.id))
    return [event for event in found if event.is_stop]


def late_stops(db: Session, participant_ids: Collection[int]) -> frozenset[int]:
    """Return the sessions with a stop that became known after their visit was locked: their own record does not have it."""
    kinds = select(AdverseEventRevision.event_id).where(AdverseEventRevision.kind == EventKind.STOPPED)
    query = _events().join(AdverseEvent.session).where(AdverseEvent.participant_id.in_(participant_ids), AdverseEvent.id.in_(kinds))
    found = db.scalars(query.where(StudySession.stopped_reason.is_(None)))
    return frozenset(event.session_id for event in found if event.is_stop and event.session_id is not None)


def event_by_key(db: Session, participant_id: int, entry_key: str) -> AdverseEvent | None:
    """A participant's event of the name that its entry had on a device."""
    mine = (AdverseEvent.participant_id == participant_id) & (AdverseEvent.entry_key == entry_key)
    return db.scalar(_events().where(mine))


def lock_event(db: Session, row: AdverseEvent) -> None:
    """Hold an event for this transaction and read its revisions again, so that two corrections at once are asked in turn."""
    db.execute(select(AdverseEvent.id).where(AdverseEvent.id == row.id).with_for_update())
    db.expire(row, ["revisions"])


def _events() -> Select[AdverseEvent]:
    return select(AdverseEvent).options(
        selectinload(AdverseEvent.revisions),
        joinedload(AdverseEvent.participant).joinedload(Participant.site),
        joinedload(AdverseEvent.visit),
        joinedload(AdverseEvent.session).joinedload(StudySession.visit).joinedload(Visit.participant).joinedload(Participant.site),
    )
