"""HTML page of what devices keep beside sessions."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from app.platform.database import Db
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant
from app.study.recordings import repository
from app.study.recordings.history import history_of
from app.study.recordings.history_charts import charts_of

router = APIRouter()


@router.get("/participants/{code}/device-history")
def device_history_page(request: Request, participant: CurrentParticipant, db: Db, report: str = "") -> HTMLResponse:
    """The newest report's history, or that of the recording `report`."""
    recordings = repository.histories(db, participant.id)
    chosen = next((r for r in recordings if str(r.id) == report), recordings[0] if recordings else None)
    history = history_of(chosen, repository.sealed_days(db, participant.id)) if chosen is not None else None
    page = render(
        request,
        "study/device_history.html",
        participant=participant,
        recordings=recordings,
        history=history,
        charts=charts_of(history) if history else [],
    )
    return HTMLResponse(page)
