"""HTML page of methods by seed."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.analysis.evaluations import service
from app.analysis.evaluations.charts import charts
from app.analysis.evaluations.export import figure_of, table_of
from app.analysis.evaluations.serializers import missing
from app.platform.database import Db
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant
from app.study.service import may

router = APIRouter()


@router.get("/participants/{code}/analyses/evaluations")
def by_seed_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """How well each method did on one snapshot, by seed."""
    found = service.by_seed(db, participant, caller)
    page = render(
        request,
        "analysis/evaluations.html",
        participant=participant,
        found=found,
        charts=charts(found),
        missing=missing(found),
        wanted=service.WANTED_SEEDS,
        may_run=may(caller, can.RUN_JOBS, participant),
    )
    return HTMLResponse(page)


@router.get("/participants/{code}/analyses/evaluations.csv")
def by_seed_table(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Methods by seed as a table."""
    return table_of(service.by_seed(db, participant, caller))


@router.get("/participants/{code}/analyses/evaluations.svg")
def by_seed_figure(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Methods by seed as a figure."""
    return figure_of(service.by_seed(db, participant, caller))
