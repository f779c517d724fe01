"""HTML pages of all participants together."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse

from app.accounts.deps import CurrentCaller
from app.analysis import wording
from app.analysis.evidence.facts import METRICS
from app.analysis.metrics import export
from app.analysis.pooled import service
from app.analysis.pooled.charts import results
from app.analysis.trial_time.service import trial_time
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.kept import kept
from app.platform.web.charts import Chart
from app.platform.web.charts import figure as empty
from app.platform.web.templates import render
from app.study.service import withdrawn_codes

router = APIRouter()


@router.get("/analyses")
def pooled_page(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """What the visits of all participants have shown."""
    participants = service.readable(db, caller)
    found = service.pooled(db, participants, caller)
    page = render(
        request,
        "analysis/pooled.html",
        found=found,
        charts=_charts(found),
        trial=found.trial,
        withdrawn=withdrawn_codes(participants),
        times=service.computation_times(db, participants),
        wording=wording,
    )
    return HTMLResponse(page)


@router.get("/analyses/figure")
def figure(db: Db, caller: CurrentCaller, metric: str = METRICS[0]) -> JSONResponse:
    """The results figure's chart of one metric, which its page draws when it comes into view."""
    if metric not in METRICS:
        raise NotFound(f"There is no metric '{metric[:40]}'.", f"The metrics are {', '.join(METRICS)}.")
    charts = {c.id: c.figure for c in _charts(service.pooled(db, service.readable(db, caller), caller))}
    return JSONResponse(charts.get(f"all-{metric}") or empty([]))


def _charts(found: service.Pooled) -> list[Chart]:
    """Made once for what the visits have shown."""
    return kept(("results figure", tuple(p.evidence.key for p in found.participants)), lambda: results(found.paper))


@router.get("/analyses/results.csv")
def results_table(db: Db, caller: CurrentCaller) -> Response:
    """The paper's comparisons of all participants as a table."""
    return export.table(service.pooled(db, service.readable(db, caller), caller).paper, "all")


@router.get("/analyses/results.svg")
def results_figure(db: Db, caller: CurrentCaller) -> Response:
    """The results figure of all participants."""
    return export.svg(service.pooled(db, service.readable(db, caller), caller).paper, "all")


@router.get("/trial-time")
def trial_time_page(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Minutes of every controller in every participant that the caller may read."""
    participants = service.readable(db, caller)
    trial = trial_time(db, participants, caller)
    return HTMLResponse(render(request, "analysis/trial_time.html", trial=trial, withdrawn=withdrawn_codes(participants)))
