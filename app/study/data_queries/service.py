"""Rules of data queries. The caller commits.

Whoever may ask (monitors, coordinators, those above them) opens, closes and opens again; whoever enters data answers. A locked visit can be
asked about too: a query changes no value. Each entry keeps the value as it stood, so that what was corrected stays readable.
"""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.errors import Conflict, Invalid, NotFound, about
from app.study import access
from app.study import repository as study_repository
from app.study.adverse_events import repository as events
from app.study.data_queries import repository
from app.study.data_queries.fields import Found, value_of
from app.study.data_queries.schemas import DataQueryEntryIn, DataQueryIn
from app.tables.data_queries import OF_PARTICIPANT, DataQuery, DataQueryEntry, QueryState, Subject
from app.tables.participants import Participant

_FOLLOWS: dict[QueryState, frozenset[QueryState]] = {
    QueryState.OPEN: frozenset({QueryState.ANSWERED, QueryState.CLOSED}),
    QueryState.ANSWERED: frozenset({QueryState.CLOSED, QueryState.OPEN}),
    QueryState.CLOSED: frozenset({QueryState.OPEN}),
}


def ask(db: Session, participant: Participant, draft: DataQueryIn, caller: Caller) -> DataQuery:
    """Ask about a value, or about an upload.

    Raises:
        Forbidden: the caller may not ask. NotFound: what is asked about is not the participant's. Invalid: nothing was asked.
    """
    access.require(caller, can.ASK_QUERIES, participant)
    named = {f"{s.value}_id": getattr(draft, f"{s.value}_id") for s in Subject if s not in OF_PARTICIPANT}
    row = DataQuery(participant_id=participant.id, participant=participant, record=draft.record, field=draft.field, **named)
    with about("record" if draft.record else f"{draft.subject.value}_id"):
        found = _found(db, row, caller)
        if found is None and not (row.upload_id is not None and repository.upload_of(db, participant.id, row.upload_id)):
            raise NotFound(f"Participant {participant.code} has no {draft.subject.value} {row.subject_id}.")
    row.entries.append(_entry(QueryState.OPEN, draft.text, row, found, caller))
    db.add(row)
    db.flush()
    return repository.data_query(db, row.id, caller)


def follow(db: Session, query: DataQuery, given: DataQueryEntryIn, caller: Caller) -> DataQuery:
    """Answer a query, close it, or open it again.

    Raises:
        Forbidden: the caller may not. Conflict: somebody said something meanwhile, or the query is closed or answered already.
        Invalid: nothing was said.
    """
    access.require(caller, can.WRITE_STUDY if given.state is QueryState.ANSWERED else can.ASK_QUERIES, query.participant)
    repository.lock_query(db, query)
    if len(query.entries) != given.entries:
        raise Conflict(f"{query.entries[-1].entered_by} said something to data query {query.id} after you opened it.", "Load it again.")
    if given.state not in _FOLLOWS[query.state]:
        raise Conflict(f"Data query {query.id} is {query.state.value}, and cannot become {given.state.value}.", "Load it again.")
    query.entries.append(_entry(given.state, given.text, query, _found(db, query, caller), caller))
    db.flush()
    return query


def _entry(state: QueryState, said: str, query: DataQuery, found: Found, caller: Caller) -> DataQueryEntry:
    if not said.strip():
        raise Invalid("Nothing is said.", "Write what you ask, answer, or why the query is closed.", field="text")
    value = value_of(query.subject, query.field, found)
    return DataQueryEntry(state=state, text=said.strip(), value=value, entered_by=caller.label)


def _found(db: Session, query: DataQuery, caller: Caller) -> Found:
    """The row that holds the value; None of an upload, and of a dose that was taken back. Raises NotFound for another participant's."""
    participant, number = query.participant, query.subject_id
    if number is None:
        return participant
    what = f"{query.subject.value} {number}"
    if query.subject is Subject.SESSION:
        session = study_repository.session(db, number, caller)
        access.require_own(participant, session.visit, what)
        return session
    if query.subject is Subject.VISIT:
        visit = study_repository.visit(db, number, caller)
        access.require_own(participant, visit, what)
        return visit
    if query.subject is Subject.EVENT:
        event = events.event(db, number, caller)
        access.require_own(participant, event, what)
        return event
    return repository.dose_of(db, participant.id, number) if query.subject is Subject.DOSE else None
