"""HTML pages of the analysis."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse

from app.accounts.deps import CurrentCaller
from app.analysis.evidence.service import evidence
from app.analysis.metrics import export, service
from app.analysis.metrics.charts import view
from app.platform.database import Db
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant

router = APIRouter()


@router.get("/participants/{code}/analyses/paper")
def analyses(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """The five metrics by controller, with tests, tables and limits."""
    held = evidence(db, participant, caller)
    analysis = view(service.five_metrics(db, participant, caller, held), held.key)
    return HTMLResponse(render(request, "analysis/analyses.html", participant=participant, analysis=analysis))


@router.get("/participants/{code}/analyses/paper.csv")
def paper_table(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """The paper's comparisons as a table."""
    return export.table([service.five_metrics(db, participant, caller)], participant.code)


@router.get("/participants/{code}/analyses/paper.svg")
def paper_figure(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """The results figure of one participant."""
    return export.svg([service.five_metrics(db, participant, caller)], participant.code)
