"""HTML page of beta as a biomarker."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from app.accounts.deps import CurrentCaller
from app.analysis import wording
from app.analysis.biomarker import service
from app.analysis.biomarker.charts import NAMES, scatter, unit
from app.platform.database import Db
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant

router = APIRouter()


@router.get("/participants/{code}/analyses/beta")
def biomarker_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Is beta a biomarker here, how did the months go, and what does a dose do?"""
    found = service.biomarker(db, participant, caller)
    pairs = [*found.beta, *found.progression, *found.medication]
    page = render(
        request,
        "analysis/beta.html",
        participant=participant,
        found=found,
        charts={(p.x, p.y): scatter(p, found.beta_unit) for p in pairs if p.points},
        names=NAMES,
        unit=lambda name: unit(name, found.beta_unit),
        wording=wording,
    )
    return HTMLResponse(page)
