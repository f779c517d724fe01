"""HTML page of the quarantine: what could not be read, and what a person decides on it."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.ingest import repository
from app.ingest.quarantine import service as quarantine
from app.ingest.quarantine.serializers import original, problem_of
from app.ingest.uploads.interrupted import why_left
from app.ingest.wording import KIND_NAMES
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import FormValues, field_notes
from app.platform.web.schemas import RowId
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant
from app.tables.participants import Participant

router = APIRouter()


@router.get("/participants/{code}/quarantine")
def quarantine_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show files of a participant that could not all be read."""
    return _page(request, db, participant, caller)


@router.post("/uploaded-files/{file_id}/decision")
def decide(request: Request, file_id: RowId, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Review, release or discard a file."""
    _, participant = repository.upload_file(db, file_id, caller)
    how, reason = str(values.get("do", "")), str(values.get("reason", ""))[:1000]
    try:
        if how == "review":
            return original(quarantine.review(db, file_id, caller), file_id)
        if how == "read":
            quarantine.read_again(db, file_id, reason, caller)
        elif how == "as_is":
            quarantine.release_as_is(db, file_id, reason, caller)
        elif how == "discard":
            quarantine.discard(db, file_id, reason, caller)
        else:
            raise Invalid("No decision was chosen.", "Press one of the buttons.")
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, participant, caller, error, {file_id: reason})
    return RedirectResponse(f"/participants/{participant.code}/quarantine?done={how}", 303)


def _page(
    request: Request,
    db: Session,
    participant: Participant,
    caller: Caller,
    error: BetaloopError | None = None,
    typed: dict[int, str] | None = None,
) -> HTMLResponse:
    rows = repository.quarantined_files(db, participant.id)
    page = render(
        request,
        "ingest/quarantine.html",
        participant=participant,
        held=[(f, problem_of(f)) for f in rows if f.quarantine_sha256 is not None],
        kind_names=KIND_NAMES,
        decided=[f for f in rows if f.quarantine_sha256 is None],
        left=why_left(participant),
        may_decide=caller.may(can.DECIDE_QUARANTINE, participant.site.study_id, participant.site_id),
        typed=typed or {},
        remarks=field_notes(error, {"reason": ""}),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
