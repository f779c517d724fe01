"""REST routes of the clinic day."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.planning.visit_day import repository, service
from app.planning.visit_day.schemas import DayOut, EntriesIn, EntriesOut, EntryOut
from app.planning.visit_day.serializers import day_out
from app.platform.database import Db, now
from app.platform.web.schemas import Page, PagingQuery, problems
from app.study.deps import CurrentVisit, VisitViewed

router = APIRouter(tags=["clinic day"], responses=problems(401, 403, 404, 422))


@router.get("/visits/{visit_id}/day", responses=problems(409))
def read_day(visit: CurrentVisit, db: Db, caller: CurrentCaller) -> DayOut:
    """Return the clinic day of a visit: the sessions of its approved plan, and what has been entered. Blinded readers see labels."""
    return day_out(service.read_day(db, visit, caller), caller)


@router.get("/visits/{visit_id}/day/entries", dependencies=[VisitViewed])
def list_entries(visit: CurrentVisit, db: Db, caller: CurrentCaller, paging: PagingQuery) -> Page[EntryOut]:
    """List everything that was entered on the clinic day of a visit, also under a plan that was replaced since, as it arrived."""
    rows, total = repository.entries_of_visit(db, visit.id, paging.limit, paging.offset)
    return Page(items=[EntryOut.model_validate(row) for row in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.post("/visits/{visit_id}/day/entries")
def add_entries(visit: CurrentVisit, batch: EntriesIn, db: Db, caller: CurrentCaller) -> EntriesOut:
    """Take entries of a tablet.

    The same entry again is `known`; one that cannot be taken is `refused` with the reason, and the others are stored.
    """
    results = service.add_entries(db, visit, batch.plan_id, batch.entries, caller)
    return EntriesOut(server_time=now(), results=results)
