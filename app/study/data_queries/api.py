"""REST routes of data queries."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.data_queries import repository, service
from app.study.data_queries.deps import CurrentDataQuery
from app.study.data_queries.schemas import DataQueryEntryIn, DataQueryIn, DataQueryOut
from app.study.deps import CurrentParticipant
from app.tables.data_queries import DataQuery, QueryState

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/data-queries", response_model=list[DataQueryOut])
def list_data_queries(participant: CurrentParticipant, db: Db, state: QueryState | None = None) -> list[DataQuery]:
    """A participant's data queries in the order in which they were asked; of one state where it is named."""
    found = repository.queries_of_participant(db, participant.id)
    return [row for row in found if state in (None, row.state)]


@router.post("/participants/{code}/data-queries", response_model=DataQueryOut, status_code=201)
def ask_data_query(participant: CurrentParticipant, draft: DataQueryIn, db: Db, caller: CurrentCaller) -> DataQuery:
    """Ask about a value of a session, visit, dose, adverse event, the settings or the characteristics; or about an upload."""
    return service.ask(db, participant, draft, caller)


@router.post("/data-queries/{query_id}/entries", response_model=DataQueryOut, status_code=201, responses=problems(409))
def follow_data_query(query: CurrentDataQuery, given: DataQueryEntryIn, db: Db, caller: CurrentCaller) -> DataQuery:
    """Answer a query, close it, or open it again. Corrections are made where the value stands; the query keeps the old one."""
    return service.follow(db, query, given, caller)
