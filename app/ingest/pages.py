"""HTML pages of uploads: drag and drop, and what became of every file."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, get_args

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.responses import HTMLResponse
from pydantic import Field
from sqlalchemy.orm import Session

from app.accounts import policy as can
from app.accounts.deps import CurrentCaller
from app.accounts.policy import Caller
from app.ingest import repository, service
from app.ingest.schemas import UploadForm
from app.ingest.service import BetaStated, Incoming, UploadOutcome
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.forms import parse
from app.platform.schemas import RowId, Text
from app.platform.templates import render
from app.settings import get_settings
from app.study import repository as study
from app.study import service as study_service
from app.study.api import CurrentParticipant
from app.study.blinding import CONTROLLER_NAMES
from app.study.models import Participant, Visit
from app.study.schemas import BetaSource
from app.study.settings_form import SOURCES

router = APIRouter()

_LABELS = {
    "visit": "Visit", "controller": "Controller", "policy": "Policy", "started_at": "Start", "hemisphere": "Hemisphere",
    "beta_unit": "Unit of beta", "beta_source": "Source of beta",
}  # fmt: skip


class _PageForm(UploadForm):
    """The upload form with what a person may say of a table's beta."""

    beta_unit: Text | None = Field(None, max_length=40)
    beta_source: BetaSource | None = None


@router.get("/participants/{code}/upload")
def upload_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, visit: str = "") -> HTMLResponse:
    """The upload form and the uploads so far."""
    study_service.require(caller, can.UPLOAD, participant)
    return _page(request, db, participant, {"visit": visit})


@router.post("/participants/{code}/upload")
def upload(
    request: Request,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    file: Annotated[list[UploadFile], File()],
    visit: Annotated[str, Form()] = "",
    controller: Annotated[str, Form()] = "",
    policy: Annotated[str, Form()] = "",
    started_at: Annotated[str, Form()] = "",
    hemisphere: Annotated[str, Form()] = "",
    beta_unit: Annotated[str, Form()] = "",
    beta_source: Annotated[str, Form()] = "",
) -> HTMLResponse:
    """Take files without JavaScript: one session per file; the answer names every file's fate. Sending again changes nothing."""
    typed = {"visit": visit, "controller": controller, "policy": policy, "started_at": started_at, "hemisphere": hemisphere}
    typed |= {"beta_unit": beta_unit, "beta_source": beta_source}
    outcomes: list[UploadOutcome] = []
    try:
        form = parse(_PageForm, typed, _LABELS)
        stated = service.state_session(db, participant, form.visit, form.controller, form.policy or None, form.started_at, form.hemisphere)
        chosen = [Incoming(f.filename or "file", f.file) for f in file if f.filename]
        if not chosen:
            raise Invalid("No file was chosen.", "Choose at least one file.")
        for one in chosen:
            outcomes.append(service.receive(db, participant, stated, [one], caller, BetaStated(form.beta_unit, form.beta_source)))
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, participant, typed, outcomes, error)
    return _page(request, db, participant, typed, outcomes)


@router.get("/uploads/{upload_id}")
def report(request: Request, upload_id: RowId, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """What became of the files of one upload."""
    row, participant = repository.upload(db, upload_id, caller)
    return HTMLResponse(render(request, "ingest/report.html", participant=participant, outcome=_outcome(db, row.id, caller)))


def _outcome(db: Session, upload_id: int, caller: Caller) -> UploadOutcome:
    row, participant = repository.upload(db, upload_id, caller)
    return UploadOutcome(row, participant, service.stored_outcomes(db, row))


def _likely_visit(visits: Sequence[Visit]) -> str:
    """Number of the visit that files probably belong to; empty where none has taken place yet.

    Args:
        visits: by number. The last one counts where it has no date, else the newest whose date is not in the future.
    """
    if visits and visits[-1].date is None:
        return str(visits[-1].number)
    today = datetime.now(UTC).date()
    past = [(v.date, v.number) for v in visits if v.date is not None and v.date <= today]
    return str(max(past)[1]) if past else ""


def _page(
    request: Request,
    db: Session,
    participant: Participant,
    typed: dict[str, str],
    outcomes: list[UploadOutcome] | None = None,
    error: BetaloopError | None = None,
) -> HTMLResponse:
    visits, _ = study.visits(db, participant.id, 1000, 0)
    known = dict.fromkeys(_LABELS, "") | typed
    known["visit"] = typed.get("visit") or _likely_visit(visits)
    page = render(
        request,
        "ingest/upload.html",
        participant=participant,
        visits=visits,
        controllers=[("", "choose …"), *((c.value, name) for c, name in CONTROLLER_NAMES.items())],
        sources=[("", "as in the settings"), *((s, label) for s, label in SOURCES if s in get_args(BetaSource))],
        policies=study.policy_names(db, participant.id),
        typed=known,
        outcomes=outcomes or [],
        uploads=repository.uploads_of_participant(db, participant.id),
        limit_mb=get_settings().upload_limit_mb,
        problem=error.problem(request.url.path) if error else None,
    )
    unusable = bool(outcomes) and not any(o.usable for o in outcomes or [])
    return HTMLResponse(page, error.status if error else 422 if unusable else 200)
