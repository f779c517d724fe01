"""REST routes of sweeps."""

from __future__ import annotations

from fastapi import APIRouter

from app.learning import repository
from app.learning.deps import CurrentSweep, SweepViewed
from app.learning.schemas import SweepOut
from app.learning.serializers import sweep_out
from app.platform.database import Db
from app.platform.web.schemas import Page, PagingQuery, problems
from app.study.deps import CurrentParticipant, ResultsViewed

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/sweeps", dependencies=[ResultsViewed])
def list_sweeps(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[SweepOut]:
    """Sweeps of a participant, newest first."""
    rows, total = repository.sweeps(db, participant.id, paging.limit, paging.offset)
    return Page(items=[sweep_out(db, s) for s in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.get("/sweeps/{sweep_id}", dependencies=[SweepViewed])
def read_sweep(sweep: CurrentSweep, db: Db) -> SweepOut:
    """One sweep: its policies on sessions they did not learn from, and the scores of controllers without learning."""
    return sweep_out(db, sweep)
