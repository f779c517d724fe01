"""Data queries: a monitor or coordinator asks about a value, a person answers, and the one who may ask closes it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError
from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session, joinedload, selectinload

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.errors import Conflict, Invalid, NotFound, about
from app.platform.web.schemas import CodeOf, Int, Model, Text
from app.study import access
from app.study import adverse_events as events
from app.study import repository as study_repository
from app.study.adverse_event_types import CHOICES
from app.study.characteristics import CharacteristicsFields, fields_of
from app.study.repository import in_scope
from app.study.settings_form import LABELS as SETTING_LABELS
from app.study.settings_types import SettingsFields
from app.tables.adverse_events import AdverseEvent
from app.tables.data_queries import OF_PARTICIPANT, DataQuery, DataQueryEntry, QueryState, Subject
from app.tables.participants import Hemisphere, Participant
from app.tables.sessions import StudySession
from app.tables.uploads import Upload
from app.tables.visits import Dose, Visit
from ml.outcomes import FIELDS as OUTCOME_FIELDS
from ml.outcomes import OUTCOMES

# Words of the values that a query is about.

QUERIED_FIELDS = {
    **{o.field: o.label for o in OUTCOMES},
    "controller": "Controller",
    "started_at": "Start",
    "hemisphere": "Hemisphere",
    "medication_h": "Time since the last dose",
    "stopped_reason": "Early stop",
    "file": "Uploaded file",
    "date": "Date",
    "cdbs_left": "cDBS amplitude, left",
    "cdbs_right": "cDBS amplitude, right",
    "note": "Note",
    "drug": "Drug",
    "mg": "Dose",
    "taken_at": "Time it was taken",
    "kind": "What happened",
    "severity": "Severity",
    "serious": "Whether it is serious",
    "occurred_at": "When it happened",
    "ended_at": "When it ended",
    **{name: label for name, (label, _) in CHOICES.items()},
    "leads": "Leads",
    "symptoms": "Symptoms",
    "hand": "Hand of the grasp test",
    "medication": "Medication of a visit day",
    **SETTING_LABELS,
    "other": "Something else",
}
"""Values that a data query may be about, by the name of their field."""


ASKED_ABOUT = {name: said[:1].lower() + said[1:] if said[:2] not in ("cD", "r_") else said for name, said in QUERIED_FIELDS.items()}
"""The same within a sentence."""


# Values that may be asked about, by their record, and the present value of each.

OTHER = "other"
"""Anything else, described in the text."""
FIELDS: Mapping[Subject, tuple[str, ...]] = {
    Subject.SESSION: (*OUTCOME_FIELDS, "controller", "started_at", "hemisphere", "medication_h", "stopped_reason", OTHER),
    Subject.UPLOAD: ("file", OTHER),
    Subject.VISIT: ("date", "cdbs_left", "cdbs_right", "note", OTHER),
    Subject.DOSE: ("drug", "mg", "taken_at", OTHER),
    Subject.EVENT: ("kind", "severity", "serious", "occurred_at", "ended_at", *CHOICES, "note", OTHER),
    Subject.SETTINGS: (*SettingsFields.model_fields, OTHER),
    Subject.CHARACTERISTICS: (*CharacteristicsFields.model_fields, OTHER),
}
NOT_KEPT = frozenset({"controller", "file", OTHER})
"""Values that are not kept with an entry: controllers come only through the blinding gate, and the others are not one value."""

Found = StudySession | Visit | Dose | AdverseEvent | Participant | None


def value_of(subject: Subject, field: str, found: Found) -> str | None:
    """Return a present value as text; None where there is none, where it is not kept, and of a removed dose.

    Args:
        found: the row that holds it; of settings and characteristics the participant.
    """
    if found is None or field in NOT_KEPT:
        return None
    value = _READ[subject](found, field)
    if value is None or value == "":
        return None
    return value if isinstance(value, str) else json.dumps(value) if isinstance(value, list | dict | bool) else str(value)


def _of_session(session: Any, field: str) -> Any:
    return getattr(session.qoc, field, None) if field in OUTCOME_FIELDS else getattr(session, field)


def _of_visit(visit: Any, field: str) -> Any:
    side = {"cdbs_left": Hemisphere.LEFT, "cdbs_right": Hemisphere.RIGHT}.get(field)
    if side is None:
        return getattr(visit, field)
    stated = sorted((a.program, a.amplitude_ma) for a in visit.cdbs_amplitudes if a.hemisphere == side)
    return ", ".join(f"{ma:g} mA" + (f" (program {program})" if program else "") for program, ma in stated)


def _of_event(event: Any, field: str) -> Any:
    return event.occurred_at if field == "occurred_at" else getattr(event.now, field)


def _of_characteristics(participant: Any, field: str) -> Any:
    return fields_of(participant.current_characteristics).model_dump(mode="json")[field]


_READ: Mapping[Subject, Callable[[Any, str], Any]] = {
    Subject.SESSION: _of_session,
    Subject.VISIT: _of_visit,
    Subject.DOSE: getattr,
    Subject.EVENT: _of_event,
    Subject.SETTINGS: lambda participant, field: getattr(participant.current_settings, field),
    Subject.CHARACTERISTICS: _of_characteristics,
}


# API types of data queries.

_NAMED = "; ".join(f"of {subject.value} {', '.join(names[:-1])}" for subject, names in FIELDS.items())


class DataQueryIn(Model):
    """A question about a value, or about an upload: of a session, upload, visit, dose or adverse event, or of the participant's settings or
    characteristics."""

    session_id: Int | None = Field(None, ge=1)
    upload_id: Int | None = Field(None, ge=1)
    visit_id: Int | None = Field(None, ge=1)
    dose_id: Int | None = Field(None, ge=1)
    event_id: Int | None = Field(None, ge=1, description="Of an adverse event.")
    record: Literal["settings", "characteristics"] | None = Field(None, description="Of the participant: the present version.")
    field: Text = Field(
        min_length=1, max_length=40, description="Which value, by its name: " + _NAMED + ". `other` is described in the text."
    )
    text: Text = Field(min_length=1, max_length=2000, description="What is asked, without names or dates.")

    @model_validator(mode="after")
    def _one_subject(self) -> Self:
        if len(self._stated()) != 1:
            raise PydanticCustomError("subject", "name one thing that is asked about: a session, upload, visit, dose, event or record")
        if self.field not in FIELDS[self.subject]:
            raise PydanticCustomError(
                "field",
                "a {subject} is asked about as one of {fields}",
                {"subject": self.subject.value, "fields": ", ".join(FIELDS[self.subject])},
            )
        return self

    def _stated(self) -> list[Subject]:
        numbered = [s for s in Subject if s not in OF_PARTICIPANT and getattr(self, f"{s.value}_id") is not None]
        return [*numbered, *([Subject(self.record)] if self.record is not None else [])]

    @property
    def subject(self) -> Subject:
        """Kind of record with the value."""
        return self._stated()[0]


class DataQueryEntryIn(Model):
    """An answer, a closing, or a question asked again."""

    state: QueryState = Field(description="`answered` by those who enter data; `closed` and `open` by those who ask.")
    text: Text = Field(min_length=1, max_length=2000)
    entries: Int = Field(ge=1, description="How many entries the caller has read; 409 where there are more by now.")


class DataQueryEntryOut(Model):
    """Entry of a data query."""

    state: QueryState
    text: str
    value: str | None = Field(description="The value as it stood; null where there was none, and of controllers and files.")
    entered_by: str
    created_at: datetime


class DataQueryOut(Model):
    """Data query with all its entries."""

    id: int
    participant: CodeOf
    session_id: int | None
    upload_id: int | None
    visit_id: int | None
    dose_id: int | None
    event_id: int | None
    record: Literal["settings", "characteristics"] | None
    field: str
    state: QueryState
    entries: list[DataQueryEntryOut]


# Queries of the tables of data queries, within what the caller may read.


def data_query(db: Session, query_id: int, caller: Caller) -> DataQuery:
    """Load a query. Raises NotFound."""
    mine = _queries().join(DataQuery.participant).join(Participant.site).where(DataQuery.id == query_id, in_scope(caller))
    row = db.scalar(mine)
    if row is None:
        raise NotFound(f"There is no data query {query_id}, or you have no access to it.")
    return row


def queries_of_participant(db: Session, participant_id: int) -> Sequence[DataQuery]:
    """Load a participant's queries in the order in which they were asked."""
    return db.scalars(_queries().where(DataQuery.participant_id == participant_id).order_by(DataQuery.id)).all()


def numbers_of_session(db: Session, session_id: int) -> list[int]:
    """List the numbers of all queries about a session, closed ones too."""
    return list(db.scalars(select(DataQuery.id).where(DataQuery.session_id == session_id).order_by(DataQuery.id)))


def not_closed_of_session(db: Session, session_id: int) -> int:
    """Count the queries about a session that are not closed."""
    newest = select(func.max(DataQueryEntry.id)).join(DataQuery).where(DataQuery.session_id == session_id).group_by(DataQuery.id)
    waiting = select(func.count()).where(DataQueryEntry.id.in_(newest), DataQueryEntry.state != QueryState.CLOSED)
    return db.scalar(waiting) or 0


def lock_query(db: Session, row: DataQuery) -> None:
    """Lock a query for this transaction and read its entries again, so that two answers at once are taken in turn."""
    db.execute(select(DataQuery.id).where(DataQuery.id == row.id).with_for_update())
    db.expire(row, ["entries"])


def dose_of(db: Session, participant_id: int, dose_id: int) -> Dose | None:
    """Find a dose of the participant; None without one, or where it was removed."""
    return db.scalar(select(Dose).join(Visit, Visit.id == Dose.visit_id).where(Dose.id == dose_id, Visit.participant_id == participant_id))


def visit_number(db: Session, visit_id: int | None) -> int | None:
    """Return the number that people give a visit."""
    return db.scalar(select(Visit.number).where(Visit.id == visit_id))


def upload_of(db: Session, participant_id: int, upload_id: int) -> bool:
    """Return True for an upload of the participant."""
    return db.scalar(select(Upload.id).where(Upload.id == upload_id, Upload.participant_id == participant_id)) is not None


def _queries() -> Select[DataQuery]:
    return select(DataQuery).options(
        selectinload(DataQuery.entries), joinedload(DataQuery.participant).joinedload(Participant.site), joinedload(DataQuery.session)
    )


# Rules of data queries. The caller commits.
#
# Those who may ask (monitors, coordinators, those above them) open, close and open again; those who enter data answer. A locked visit
# can be asked about too: a query changes no value. Each entry keeps the value as it stood, so that what was corrected stays readable.

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
        if found is None and not (row.upload_id is not None and upload_of(db, participant.id, row.upload_id)):
            raise NotFound(f"Participant {participant.code} has no {draft.subject.value} {row.subject_id}.")
    row.entries.append(_entry(QueryState.OPEN, draft.text, row, found, caller))
    db.add(row)
    db.flush()
    return data_query(db, row.id, caller)


def follow(db: Session, query: DataQuery, given: DataQueryEntryIn, caller: Caller) -> DataQuery:
    """Answer a query, close it, or open it again.

    Raises:
        Forbidden: the caller may not. Conflict: another person answered meanwhile, or the query is closed or answered already.
        Invalid: the text is empty.
    """
    access.require(caller, can.WRITE_STUDY if given.state is QueryState.ANSWERED else can.ASK_QUERIES, query.participant)
    lock_query(db, query)
    if len(query.entries) != given.entries:
        raise Conflict(f"{query.entries[-1].entered_by} wrote to data query {query.id} after you opened it.", "Load it again.")
    if given.state not in _FOLLOWS[query.state]:
        raise Conflict(f"Data query {query.id} is {query.state.value}, and cannot become {given.state.value}.", "Load it again.")
    query.entries.append(_entry(given.state, given.text, query, _found(db, query, caller), caller))
    db.flush()
    return query


def _entry(state: QueryState, said: str, query: DataQuery, found: Found, caller: Caller) -> DataQueryEntry:
    if not said.strip():
        raise Invalid("The text is empty.", "Write what you ask, answer, or why the query is closed.", field="text")
    value = value_of(query.subject, query.field, found)
    return DataQueryEntry(state=state, text=said.strip(), value=value, entered_by=caller.label)


def _found(db: Session, query: DataQuery, caller: Caller) -> Found:
    """Find the row that holds the value; None of an upload, and of a removed dose. Raises NotFound for another participant's."""
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
    return dose_of(db, participant.id, number) if query.subject is Subject.DOSE else None
