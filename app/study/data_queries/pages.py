"""HTML page of a participant's data queries; the session and upload pages lead to it."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, parse
from app.platform.web.templates import render
from app.study.data_queries import repository, service
from app.study.data_queries.deps import CurrentDataQuery
from app.study.data_queries.models import QueryState
from app.study.data_queries.schemas import DataQueryEntryIn, DataQueryIn
from app.study.deps import CurrentParticipant
from app.study.models import Participant
from app.study.service import may
from app.study.wording import QUERIED_FIELDS

router = APIRouter()

_LABELS = {"session_id": "Session", "upload_id": "Upload", "field": "About", "text": "Text", "state": "State", "entries": "Entries"}
_ORDER = {QueryState.OPEN: 0, QueryState.ANSWERED: 1, QueryState.CLOSED: 2}


@router.get("/participants/{code}/data-queries")
def data_queries(
    request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, session: str = "", upload: str = ""
) -> HTMLResponse:
    """A participant's queries, open ones first, and a form to ask; `session` and `upload` fill it in."""
    return _page(request, participant, db, caller, {"session_id": session[:10], "upload_id": upload[:10]})


@router.post("/participants/{code}/data-queries")
def ask_data_query(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Ask about a value."""
    typed = {name: str(values[name]) for name in DataQueryIn.model_fields if name in values}
    try:
        service.ask(db, participant, parse(DataQueryIn, typed, _LABELS), caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, participant, db, caller, typed, error)
    db.commit()
    return RedirectResponse(f"/participants/{participant.code}/data-queries?done=asked", 303)


@router.post("/data-queries/{query_id}/entries")
def follow_data_query(request: Request, query: CurrentDataQuery, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Answer a query, close it, or open it again."""
    typed = {name: str(values[name]) for name in DataQueryEntryIn.model_fields if name in values}
    try:
        given = parse(DataQueryEntryIn, typed, _LABELS)
        service.follow(db, query, given, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, query.participant, db, caller, {}, error)
    db.commit()
    return RedirectResponse(f"/participants/{query.participant.code}/data-queries?done={given.state.value}", 303)


def _page(
    request: Request, participant: Participant, db: Session, caller: Caller, typed: dict[str, str], error: BetaloopError | None = None
) -> HTMLResponse:
    found = repository.queries_of_participant(db, participant.id)
    page = render(
        request,
        "study/data_queries.html",
        participant=participant,
        queries=sorted(found, key=lambda q: (_ORDER[q.state], -q.id)),
        fields=QUERIED_FIELDS,
        typed=typed,
        may_ask=may(caller, can.ASK_QUERIES, participant),
        may_answer=may(caller, can.WRITE_STUDY, participant),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
