"""Adverse events of a participant: what happened, how badly, under what; cleared by a clinician. Revisions are only added."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import datetime

from sqlalchemy import Select, String, cast, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, joinedload, selectinload

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid, NotFound, about
from app.study import access, blinding
from app.study import repository as study_repository
from app.study.adverse_event_types import AdverseEventChange, AdverseEventFields, AdverseEventIn, AdverseEventOut
from app.study.repository import in_scope
from app.tables.adverse_events import AdverseEvent, AdverseEventRevision, EventKind, Severity
from app.tables.participants import Participant
from app.tables.plans import DayEntry
from app.tables.sessions import StudySession
from app.tables.visits import Visit

# Queries of adverse events, within what the caller may read.


def event(db: Session, event_id: int, caller: Caller) -> AdverseEvent:
    """Load an event. Raises NotFound."""
    query = _events().join(AdverseEvent.participant).join(Participant.site).where(AdverseEvent.id == event_id, in_scope(caller))
    row = db.scalar(query)
    if row is None:
        raise NotFound(f"There is no adverse event {event_id}, or you have no access to it.")
    return row


def events_of_participant(db: Session, participant_id: int) -> Sequence[AdverseEvent]:
    """Load a participant's events in the order in which they were entered."""
    return db.scalars(_events().where(AdverseEvent.participant_id == participant_id).order_by(AdverseEvent.id)).all()


def events_of_all(db: Session, caller: Caller, limit: int, offset: int) -> tuple[Sequence[AdverseEvent], int]:
    """Load a page of the events of all participants that the caller may read, the newest first, and count them."""
    query = _events().join(AdverseEvent.participant).join(Participant.site).where(in_scope(caller))
    total = study_repository.count(db, query)
    return db.scalars(query.order_by(AdverseEvent.id.desc()).limit(limit).offset(offset)).all(), total


def with_blocking_events(db: Session) -> Sequence[Participant]:
    """Return the participants of this installation with a serious event or a stop, cleared or not."""
    blocking = AdverseEventRevision.serious | (AdverseEventRevision.kind == EventKind.STOPPED)
    serious = select(AdverseEvent.participant_id).join(AdverseEvent.revisions).where(blocking)
    return db.scalars(select(Participant).where(Participant.id.in_(serious)).order_by(Participant.id)).all()


def events_of_session(db: Session, session_id: int) -> Sequence[AdverseEvent]:
    """Load the events of a session in the order in which they were entered."""
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
    """Find a participant's event by the name that its entry had on a device."""
    mine = (AdverseEvent.participant_id == participant_id) & (AdverseEvent.entry_key == entry_key)
    return db.scalar(_events().where(mine))


def lock_event(db: Session, row: AdverseEvent) -> None:
    """Lock an event for this transaction and read its revisions again, so that two corrections at once are checked in turn."""
    db.execute(select(AdverseEvent.id).where(AdverseEvent.id == row.id).with_for_update())
    db.expire(row, ["revisions"])


def _events() -> Select[AdverseEvent]:
    return select(AdverseEvent).options(
        selectinload(AdverseEvent.revisions),
        joinedload(AdverseEvent.participant).joinedload(Participant.site),
        joinedload(AdverseEvent.visit),
        joinedload(AdverseEvent.session).joinedload(StudySession.visit).joinedload(Visit.participant).joinedload(Participant.site),
    )


# Rules of adverse events. The caller commits.
#
# A locked visit takes events too: what harms a participant is written down whenever it becomes known.

Events = Mapping[int, tuple[AdverseEvent, ...]]
"""Serious adverse events and stops that no clinician has cleared, by policy."""

_BELONGS = ("session_id", "visit_id", "policy_id", "occurred_at")
_KNOWN = tuple(AdverseEventFields.model_fields)


def add_adverse_event(db: Session, participant: Participant, draft: AdverseEventIn, caller: Caller) -> AdverseEvent:
    """Write down what happened. An entry that was sent before under the same key is given back and not added again.

    Args:
        db: the session. participant: to whom. draft: what happened, and in which session or at which visit under what.
        caller: may enter outcomes; blinded assessors may.

    Raises:
        Forbidden: the caller may not enter outcomes. NotFound: the session, visit or policy is not the participant's.
        Invalid: the session is of another visit, or has a policy of its own. Conflict: the session is a proposal, or the key belongs to
            an entry that says something else.
    """
    access.require(caller, can.WRITE_QOC, participant)
    if draft.entry_key is not None and (known := event_by_key(db, participant.id, draft.entry_key)):
        return _same(known, draft)
    visit_id = _checked_visit(db, participant, draft, caller)
    _require_order(draft.occurred_at, draft)
    if draft.policy_id is not None and not study_repository.has_policy(db, participant.id, draft.policy_id):
        raise Invalid(f"Participant {participant.code} has no policy {draft.policy_id}.", "Name one of this participant's policies.")
    row = AdverseEvent(
        participant_id=participant.id,
        visit_id=visit_id,
        session_id=draft.session_id,
        policy_id=draft.policy_id,
        occurred_at=draft.occurred_at,
        entry_key=draft.entry_key,
    )
    row.revisions.append(_revision(1, draft, caller))
    db.add(row)
    try:
        db.flush()
    except IntegrityError as error:  # the same entry arrived twice at once
        db.rollback()
        raise Conflict("This entry is being saved already.", "Send it again.") from error
    return event(db, row.id, caller)


def change_adverse_event(db: Session, event: AdverseEvent, change: AdverseEventChange, caller: Caller) -> AdverseEvent:
    """Correct what is known of an event: a new revision, which a clinician has not cleared.

    Raises:
        Forbidden: the caller may not correct the study's data. Conflict: another person changed it. Invalid: no reason.
    """
    access.require(caller, can.WRITE_STUDY, event.participant)
    _require_order(event.occurred_at, change)
    return _follow(db, event, change.revision, change.reason, caller, change, None)


def take_back_entry(db: Session, event: AdverseEvent, reason: str, caller: Caller) -> None:
    """Correct the event of an entry that was itself corrected to "none", unless a person has changed the event since.

    Raises:
        Forbidden: the caller may not enter outcomes.
    """
    access.require(caller, can.WRITE_QOC, event.participant)
    if event.now.revision == 1:
        none = AdverseEventFields(kind=event.now.kind, severity=Severity.NONE, serious=False, note=event.now.note)
        _follow(db, event, 1, reason, caller, none, None)


def clear_adverse_event(db: Session, event: AdverseEvent, revision: int, reason: str, caller: Caller) -> AdverseEvent:
    """State as a clinician that a serious event, or a stop, does not count against what ran.

    Args:
        revision: the one that the caller has read.

    Raises:
        Forbidden: the caller approves no plans of this participant. Conflict: it does not block, or another person changed it.
        Invalid: no reason.
    """
    access.require(caller, can.CLEAR_EVENT, event.participant)
    if not event.blocks:
        why = "not serious" if event.now.cleared_reason is None else "cleared already"
        raise Conflict(f"Adverse event {event.id} is {why}.", "Nothing waits for it.")
    return _follow(db, event, revision, reason, caller, event.now, reason.strip())


def policy_of(event: AdverseEvent, caller: Caller) -> int | None:
    """Return the policy that ran when it happened: the session's policy, else the stated one; None where it is hidden or none ran."""
    visit = event.session.visit if event.session is not None else event.visit
    if visit is not None and not blinding.may_know(visit, caller):
        return None
    if event.session is not None:
        known = blinding.visible_arm(event.session, caller)
        return known.policy_id if known else None
    site = event.participant.site
    return event.policy_id if caller.may(can.READ_ARMS, site.study_id, site.id) or visit is not None else None


def blocking_events(events: Iterable[AdverseEvent], caller: Caller) -> dict[int, tuple[AdverseEvent, ...]]:
    """Return by policy the serious events and the stops under it that no clinician has cleared, in the order of the events."""
    found: dict[int, tuple[AdverseEvent, ...]] = {}
    for event in events:
        policy_id = policy_of(event, caller) if event.blocks else None
        if policy_id is not None:
            found[policy_id] = (*found.get(policy_id, ()), event)
    return found


def blocked_policies(events: Iterable[AdverseEvent], caller: Caller) -> frozenset[int]:
    """Return the policies with serious events or stops that no clinician has cleared."""
    return frozenset(blocking_events(events, caller))


def _require_order(began: datetime | None, fields: AdverseEventFields) -> None:
    """Raise Invalid for an event that ended before it began."""
    if began is not None and fields.ended_at is not None and fields.ended_at < began:
        raise Invalid("The event ended before it began.", "Correct the end, or leave it empty.", field="ended_at")


def _checked_visit(db: Session, participant: Participant, draft: AdverseEventIn, caller: Caller) -> int | None:
    if draft.session_id is None:
        if draft.visit_id is not None:
            with about("visit_id"):
                access.require_own(participant, study_repository.visit(db, draft.visit_id, caller), f"visit {draft.visit_id}")
        return draft.visit_id
    with about("session_id"):
        session = study_repository.session(db, draft.session_id, caller)
        access.require_own(participant, session.visit, f"session {draft.session_id}")
    if session.status == "proposed":
        raise Conflict(
            f"Session {session.id} is a proposal that is not confirmed yet.",
            "Confirm it first, or name the visit alone.",
            field="session_id",
        )
    if draft.visit_id not in (None, session.visit_id):
        raise Invalid(
            f"Session {session.id} is not of visit {draft.visit_id}.", "Leave the visit out, or correct one of them.", field="visit_id"
        )
    if draft.policy_id is not None:
        raise Invalid("The session itself states what ran.", "Leave the policy out; correct the session if it names the wrong one.")
    return session.visit_id


def _same(known: AdverseEvent, draft: AdverseEventIn) -> AdverseEvent:
    first = known.revisions[0]
    # the visit of a session is filled in
    told = {n: getattr(known, n) for n in _BELONGS if n != "visit_id" or draft.visit_id is not None} | {
        n: getattr(first, n) for n in _KNOWN
    }
    if any(getattr(draft, name) != value for name, value in told.items()):
        raise Conflict(
            f"The entry key '{draft.entry_key}' belongs to adverse event {known.id}, which says something else.",
            "Correct that event, or send a new entry under a key of its own.",
        )
    return known


def _follow(
    db: Session,
    event: AdverseEvent,
    revision: int,
    reason: str,
    caller: Caller,
    values: AdverseEventFields | AdverseEventRevision,
    cleared: str | None,
) -> AdverseEvent:
    if not reason.strip():
        raise Invalid("A reason is missing.", "Say why; it is kept with the event.", field="reason")
    lock_event(db, event)
    if event.now.revision != revision:
        raise Conflict(
            f"Adverse event {event.id} was changed by {event.now.entered_by} after you opened it; nothing was saved.", "Load it again."
        )
    set_reason(db, reason.strip())
    row = _revision(revision + 1, values, caller)
    row.reason, row.cleared_reason = reason.strip(), cleared
    event.revisions.append(row)
    db.flush()
    return event


def _revision(number: int, values: AdverseEventFields | AdverseEventRevision, caller: Caller) -> AdverseEventRevision:
    return AdverseEventRevision(
        revision=number, entered_by=caller.label, **{n: getattr(values, n) for n in _KNOWN} | {"note": values.note.strip()}
    )


# Adverse events as API types.


def event_out(event: AdverseEvent, caller: Caller) -> AdverseEventOut:
    """Convert the newest facts of an event; what ran comes through the blinding gate."""
    now = event.now
    return AdverseEventOut(
        id=event.id,
        participant=event.participant.code,
        visit_id=event.visit_id,
        session_id=event.session_id,
        policy_id=policy_of(event, caller),
        occurred_at=event.occurred_at,
        revision=now.revision,
        **{name: getattr(now, name) for name in _KNOWN},
        cleared_reason=now.cleared_reason,
        blocks=event.blocks,
        entered_by=now.entered_by,
        reason=now.reason,
        created_at=now.created_at,
    )
