"""Rules of data queries. The caller commits.

Whoever may ask (monitors, coordinators, those above them) opens, closes and opens again; whoever enters data answers. A locked visit can be
asked about too: a query changes no value. Each entry keeps the value as it stood, so that what was corrected stays readable.
"""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.errors import Conflict, Invalid, NotFound
from app.study import repository as study_repository
from app.study import service as study
from app.study.data_queries import repository
from app.study.data_queries.models import DataQuery, DataQueryEntry, QueriedField, QueryState
from app.study.data_queries.schemas import DataQueryEntryIn, DataQueryIn
from app.study.models import Participant, StudySession

NOT_KEPT = frozenset({QueriedField.CONTROLLER, QueriedField.FILE, QueriedField.OTHER})
"""Of these no value is kept with an entry: controllers are told by the blinding gate alone, and the others are not one value."""
_OF_QOC = frozenset({QueriedField.GRASP_HZ, QueriedField.RATING, QueriedField.TREMOR_PERCENT})
_FOLLOWS: dict[QueryState, frozenset[QueryState]] = {
    QueryState.OPEN: frozenset({QueryState.ANSWERED, QueryState.CLOSED}),
    QueryState.ANSWERED: frozenset({QueryState.CLOSED, QueryState.OPEN}),
    QueryState.CLOSED: frozenset({QueryState.OPEN}),
}


def ask(db: Session, participant: Participant, draft: DataQueryIn, caller: Caller) -> DataQuery:
    """Ask about a value of a session, or about an upload.

    Raises:
        Forbidden: the caller may not ask. NotFound: the session or upload is not the participant's. Invalid: nothing was asked.
    """
    study.require(caller, can.ASK_QUERIES, participant)
    session = None
    if draft.session_id is not None:
        session = study_repository.session(db, draft.session_id, caller)
        study.require_own(participant, session.visit, f"session {draft.session_id}")
    elif draft.upload_id is None or not repository.upload_of(db, participant.id, draft.upload_id):
        raise NotFound(f"Participant {participant.code} has no upload {draft.upload_id}.")
    row = DataQuery(participant_id=participant.id, session_id=draft.session_id, upload_id=draft.upload_id, field=draft.field)
    row.entries.append(_entry(QueryState.OPEN, draft.text, draft.field, session, caller))
    db.add(row)
    db.flush()
    return repository.data_query(db, row.id, caller)


def follow(db: Session, query: DataQuery, given: DataQueryEntryIn, caller: Caller) -> DataQuery:
    """Answer a query, close it, or open it again.

    Raises:
        Forbidden: the caller may not. Conflict: somebody said something meanwhile, or the query is closed or answered already.
        Invalid: nothing was said.
    """
    study.require(caller, can.WRITE_STUDY if given.state is QueryState.ANSWERED else can.ASK_QUERIES, query.participant)
    repository.lock_query(db, query)
    if len(query.entries) != given.entries:
        raise Conflict(f"{query.entries[-1].entered_by} said something to data query {query.id} after you opened it.", "Load it again.")
    if given.state not in _FOLLOWS[query.state]:
        raise Conflict(f"Data query {query.id} is {query.state.value}, and cannot become {given.state.value}.", "Load it again.")
    query.entries.append(_entry(given.state, given.text, query.field, query.session, caller))
    db.flush()
    return query


def _entry(state: QueryState, said: str, field: QueriedField, session: StudySession | None, caller: Caller) -> DataQueryEntry:
    if not said.strip():
        raise Invalid("Nothing is said.", "Write what you ask, answer, or why the query is closed.")
    return DataQueryEntry(state=state, text=said.strip(), value=_value(session, QueriedField(field)), entered_by=caller.label)


def _value(session: StudySession | None, field: QueriedField) -> str | None:
    if session is None or field in NOT_KEPT:
        return None
    found = getattr(session.qoc, field.value, None) if field in _OF_QOC else getattr(session, field.value)
    return None if found is None else str(found)
