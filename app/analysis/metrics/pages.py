"""HTML pages of the analysis."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from app.accounts.deps import CurrentCaller
from app.analysis.metrics import service
from app.analysis.metrics.charts import view
from app.analysis.trial_time.service import trial_time
from app.platform.database import Db
from app.platform.web.templates import render
from app.study import repository as study
from app.study.deps import CurrentParticipant

router = APIRouter()


@router.get("/participants/{code}/analyses/paper")
def analyses(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """The five metrics by controller, with tests, tables and limits."""
    analysis = view(service.five_metrics(db, participant, caller))
    return HTMLResponse(render(request, "analysis/analyses.html", participant=participant, analysis=analysis))


@router.get("/trial-time")
def trial_time_page(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Minutes of every controller in every participant that the caller may read."""
    participants, _ = study.participants(db, caller, 1000, 0)
    return HTMLResponse(render(request, "analysis/trial_time.html", trial=trial_time(db, participants, caller)))
