"""The page that starts the next generation: what it goes on from, and one button."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.learning.schemas import ALGORITHM_NAMES
from app.learning.training_configs import FINE_TUNING, fresh_rates
from app.pipeline import next_generation as next_generation_rules
from app.pipeline.params import NextGenerationParams
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.jobs import repository as jobs
from app.platform.jobs import service as job_service
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.participants import Participant

pages = APIRouter()

REFRESH_S = 4
_LABELS = {"preset": "Size", "parents": "Policies to go on from", "tuned": "Fine-tuned from each", "count": "Trained from scratch"}


@pages.get("/participants/{code}/next-generation", dependencies=[ResultsViewed])
def next_generation(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show what the next generation would continue from, and the button that starts it."""
    return _page(request, db, participant, caller, {})


@pages.post("/participants/{code}/next-generation")
def start(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Start it; where a job does so already, or has done so from the same data, go to that one."""
    given = {name: str(values[name]) for name in _LABELS if str(values.get(name, "")).strip()}
    try:
        job = next_generation_rules.start(db, participant, parse(NextGenerationParams, given, _LABELS), caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, participant, caller, given, error)
    return RedirectResponse(f"/jobs/{job.id}?done=started", 303)


def _page(
    request: Request, db: Session, participant: Participant, caller: Caller, given: dict[str, str], error: BetaloopError | None = None
) -> HTMLResponse:
    found, params = next_generation_rules.outlook(db, participant, caller), NextGenerationParams.model_validate({})
    page = render(
        request,
        "pipeline/next_generation.html",
        participant=participant,
        found=found,
        parents=found.parents(params.parents),
        draft={name: getattr(params, name) for name in _LABELS} | given,
        algorithms=", ".join(ALGORITHM_NAMES[name] for name in params.algorithms),
        names=ALGORITHM_NAMES,
        tuning=FINE_TUNING,
        fresh=fresh_rates(params.training()),
        refresh_s=REFRESH_S,
        workers=len(jobs.live_workers(db, job_service.STALE_S)),
        remarks=field_notes(error, given),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
