"""HTML page of a participant's data queries; the session and upload pages lead to it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.schemas import RowId, problems
from app.platform.web.templates import render
from app.study import data_queries as data_queries_rules
from app.study.access import may
from app.study.data_queries import ASKED_ABOUT, FIELDS, QUERIED_FIELDS, DataQueryEntryIn, DataQueryIn, DataQueryOut
from app.study.deps import CurrentParticipant
from app.tables.data_queries import OF_PARTICIPANT, DataQuery, QueryState, Subject
from app.tables.participants import Participant

# The data query that a path names, within what the caller may read.


def current_query(query_id: RowId, db: Db, caller: CurrentCaller) -> DataQuery:
    """Load the query that the path names."""
    return data_queries_rules.data_query(db, query_id, caller)


CurrentDataQuery = Annotated[DataQuery, Depends(current_query)]


# REST routes of data queries.

api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@api.get("/participants/{code}/data-queries", response_model=list[DataQueryOut])
def list_data_queries(participant: CurrentParticipant, db: Db, state: QueryState | None = None) -> list[DataQuery]:
    """List a participant's data queries in the order in which they were asked; of one state where it is named."""
    found = data_queries_rules.queries_of_participant(db, participant.id)
    return [row for row in found if state in (None, row.state)]


@api.post("/participants/{code}/data-queries", response_model=DataQueryOut, status_code=201)
def ask_data_query(participant: CurrentParticipant, draft: DataQueryIn, db: Db, caller: CurrentCaller) -> DataQuery:
    """Ask about a value of a session, visit, dose, adverse event, the settings or the characteristics; or about an upload."""
    return data_queries_rules.ask(db, participant, draft, caller)


@api.post("/data-queries/{query_id}/entries", response_model=DataQueryOut, status_code=201, responses=problems(409))
def follow_data_query(query: CurrentDataQuery, given: DataQueryEntryIn, db: Db, caller: CurrentCaller) -> DataQuery:
    """Answer a query, close it, or open it again. Corrections are made on the page of the value; the query keeps the old one."""
    return data_queries_rules.follow(db, query, given, caller)


pages = APIRouter()


@dataclass(frozen=True)
class Followed:
    """A refused answer, closing or question asked again: of which query, and what was typed."""

    query: int
    state: str
    text: str


_LABELS = {
    "session_id": "Session", "upload_id": "Upload", "visit_id": "Visit", "dose_id": "Dose", "event_id": "Adverse event", "record": "Record",
    "field": "About", "text": "Text", "state": "State", "entries": "Entries",
}  # fmt: skip
_NAMES = {
    Subject.SESSION: "Session", Subject.UPLOAD: "Upload", Subject.VISIT: "Visit", Subject.DOSE: "Dose", Subject.EVENT: "Adverse event",
    Subject.SETTINGS: "Settings", Subject.CHARACTERISTICS: "Characteristics",
}  # fmt: skip
_ORDER = {QueryState.OPEN: 0, QueryState.ANSWERED: 1, QueryState.CLOSED: 2}


@pages.get("/participants/{code}/data-queries")
def data_queries(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show a participant's queries, open ones first, and a form to ask. A subject in the address (`visit=3`) makes it a form about that."""
    linked = {s: request.query_params.get(s.value, "")[:10] for s in Subject}
    typed = {f"{s.value}_id": number for s, number in linked.items() if s not in OF_PARTICIPANT and number}
    record = request.query_params.get("record", "")
    return _page(request, participant, db, caller, typed | ({"record": record} if record in OF_PARTICIPANT else {}))


@pages.post("/participants/{code}/data-queries")
def ask_data_query_by_form(
    request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues
) -> Response:
    """Ask about a value."""
    typed = {name: str(values[name]) for name in DataQueryIn.model_fields if name in values}
    try:
        data_queries_rules.ask(db, participant, parse(DataQueryIn, typed, _LABELS | {"": "Session"}, {"": "session_id"}), caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, participant, db, caller, typed, error)
    return RedirectResponse(f"/participants/{participant.code}/data-queries?done=asked", 303)


@pages.post("/data-queries/{query_id}/entries")
def follow_data_query_by_form(request: Request, query: CurrentDataQuery, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Answer a query, close it, or open it again."""
    typed = {name: str(values[name]) for name in DataQueryEntryIn.model_fields if name in values}
    try:
        given = parse(DataQueryEntryIn, typed, _LABELS)
        data_queries_rules.follow(db, query, given, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, query.participant, db, caller, {}, error, Followed(query.id, typed.get("state", ""), typed.get("text", "")))
    return RedirectResponse(f"/participants/{query.participant.code}/data-queries?done={given.state.value}", 303)


def _page(
    request: Request,
    participant: Participant,
    db: Session,
    caller: Caller,
    typed: dict[str, str],
    error: BetaloopError | None = None,
    followed: Followed | None = None,
) -> HTMLResponse:
    found = data_queries_rules.queries_of_participant(db, participant.id)
    subject = _subject(typed)
    page = render(
        request,
        "study/data_queries.html",
        participant=participant,
        places={q.id: _place(participant, db, q) for q in found},
        subject=subject,
        subject_name=_named(db, subject, typed) if subject else "",
        offered=FIELDS[subject] if subject else dict.fromkeys((*FIELDS[Subject.SESSION], *FIELDS[Subject.UPLOAD])),
        queries=sorted(found, key=lambda q: (_ORDER[q.state], -q.id)),
        fields=QUERIED_FIELDS,
        asked=ASKED_ABOUT,
        typed=typed,
        followed=followed,
        remarks=field_notes(error, typed | {"text": ""}),
        may_ask=may(caller, can.ASK_QUERIES, participant),
        may_answer=may(caller, can.WRITE_STUDY, participant),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)


def _subject(typed: dict[str, str]) -> Subject | None:
    """Return the subject of the form, where it names one thing that is neither a session nor an upload typed by its number."""
    if (record := typed.get("record", "")) in OF_PARTICIPANT:
        return Subject(record)
    named = [s for s in Subject if s not in OF_PARTICIPANT and re.fullmatch("[0-9]{1,9}", typed.get(f"{s.value}_id", ""))]
    return named[0] if len(named) == 1 else None


def _named(db: Session, subject: Subject, typed: dict[str, str]) -> str:
    """Name the subject of the form; a visit by the number that people give it."""
    number: int | str | None = typed.get(f"{subject.value}_id")
    if subject is Subject.VISIT and number is not None:
        number = data_queries_rules.visit_number(db, int(number))
    return f"{_NAMES[subject]} {number}" if number is not None else _NAMES[subject]


def _place(participant: Participant, db: Session, query: DataQuery) -> tuple[str, str]:
    """Name the subject of a query, and the page of its value."""
    subject, number, home = query.subject, query.subject_id, f"/participants/{participant.code}"
    if subject is Subject.DOSE and number is not None:
        dose = data_queries_rules.dose_of(db, participant.id, number)
        return ("Dose", f"/visits/{dose.visit_id}#doses") if dose else ("Dose, taken back", f"{home}/visits")
    if subject is Subject.VISIT:
        visit = data_queries_rules.visit_number(db, number)
        return f"Visit {visit}", f"/visits/{number}"
    if subject is Subject.EVENT:
        return f"Adverse event {number}", f"{home}/adverse-events"
    if number is None:
        return _NAMES[subject], f"{home}/{subject.value}"
    return f"{_NAMES[subject]} {number}", f"/{subject.value}s/{number}"
