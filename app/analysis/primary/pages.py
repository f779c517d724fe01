"""HTML pages of the primary analyses."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse

from app.accounts.deps import CurrentCaller
from app.analysis import wording
from app.analysis.evidence.facts import METRICS
from app.analysis.primary import service
from app.analysis.primary.charts import by_visit
from app.analysis.primary.export import primary_csv
from app.analysis.primary.results import PLANNED
from app.analysis.primary.serializers import unit_of
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.web.charts import written
from app.platform.web.templates import Part, make_part, render
from app.study.deps import CurrentParticipant

router = APIRouter()


@router.get("/participants/{code}/analyses")
def primary_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """What the visits have shown: verdicts, the primary comparisons, what they leave out."""
    found = service.primary(db, participant, caller)
    page = render(
        request,
        "analysis/primary.html",
        participant=participant,
        found=found,
        standings=make_part(Part.TESTED_STANDINGS, db, participant, caller),
        wording=wording,
        units=_units(found),
    )
    return HTMLResponse(page)


@router.get("/participants/{code}/analyses.csv")
def primary_table(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """The primary comparisons as a table."""
    return primary_csv(service.primary(db, participant, caller), make_part(Part.STANDINGS, db, participant, caller))


@router.get("/participants/{code}/analyses/visits/{key}")
def visits_page(request: Request, key: str, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """One controller or policy visit by visit, with the sessions behind every number and what else could explain it."""
    found = service.primary(db, participant, caller)
    result = service.result_of(found, key)
    units = _units(found)
    charts = {c.metric: by_visit(result.tested, c, units[c.metric]) for c in result.comparisons}
    sessions = {s.session_id: s for s in found.sessions}
    page = render(
        request,
        "analysis/visits.html",
        participant=participant,
        result=result,
        charts=charts,
        units=units,
        sessions=sessions,
        wording=wording,
    )
    return HTMLResponse(page)


@router.get("/participants/{code}/analyses/models/{key}")
def models_page(
    request: Request,
    key: str,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    sessions: Annotated[int, Query(ge=1, le=20)] = 3,
) -> HTMLResponse:
    """Mixed models of one controller, and what further visits would show; up to a second where nobody asked before."""
    found = service.primary(db, participant, caller)
    result = service.result_of(found, key)
    if result.tested.policy_id is not None:
        raise NotFound("Models are of controllers; their policies stand inside.", "Choose a controller.")
    page = render(
        request,
        "analysis/models.html",
        participant=participant,
        result=result,
        models=service.mixed_models(found, result.tested.controller),
        power=service.next_visits(found, result.tested.controller, sessions),
        per_arm=sessions,
        names=service.policy_names(db, participant),
        planned=result.tested.controller in PLANNED,
        units=_units(found),
        wording=wording,
    )
    return HTMLResponse(page)


def _units(found: service.Primary) -> dict[str, str]:
    """The unit in which a page shows each metric."""
    return {m: written(wording.shown_unit(m, unit_of(m, found))) for m in METRICS}
