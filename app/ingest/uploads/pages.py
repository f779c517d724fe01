"""HTML pages of uploads: drag and drop, and what became of every file."""

from __future__ import annotations

from typing import Annotated, Any, get_args

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.responses import HTMLResponse
from pydantic import Field
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.ingest import repository, wording
from app.ingest.schemas import UploadForm
from app.ingest.uploads import service
from app.ingest.uploads.early_refusal import UploadRoute
from app.ingest.uploads.in_progress import coming, told
from app.ingest.uploads.interrupted import why_left
from app.ingest.uploads.service import BetaStated, Incoming, UploadOutcome
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid, passing
from app.platform.jobs.children import limited
from app.platform.web.forms import field_notes, parse
from app.platform.web.schemas import Int, RowId, Text
from app.platform.web.templates import render
from app.settings import get_settings
from app.study import access
from app.study import repository as study
from app.study.blinding import CONTROLLER_NAMES
from app.study.deps import CurrentParticipant
from app.study.settings_form import SOURCES
from app.study.settings_types import BetaSource
from app.tables.participants import Participant
from app.tables.uploads import Upload

router = APIRouter(route_class=UploadRoute)

_LABELS = {
    "visit": "Visit", "controller": "Controller", "policy": "Policy", "started_at": "Start", "hemisphere": "Hemisphere",
    "beta_unit": "Unit of beta", "beta_source": "Source of beta", "lfp_unit": "Unit of LFP", "session": "Session of grasp files",
}  # fmt: skip


class _PageForm(UploadForm):
    """The upload form with what a person may say of tables and of grasp files."""

    beta_unit: Text | None = Field(None, max_length=40)
    beta_source: BetaSource | None = None
    lfp_unit: Text | None = Field(None, max_length=40)
    session: Int | None = Field(None, ge=1)


@router.get("/participants/{code}/upload")
def upload_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, visit: str = "") -> HTMLResponse:
    """Show the upload form and the uploads so far."""
    access.require(caller, can.UPLOAD, participant)
    limited.prepare()  # it is ready before a file is chosen
    return _page(request, db, participant, {"visit": visit} if visit else {})


@router.post("/participants/{code}/upload")
def upload(
    request: Request,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    file: Annotated[list[UploadFile] | None, File()] = None,
    visit: Annotated[str, Form()] = "",
    controller: Annotated[str, Form()] = "",
    policy: Annotated[str, Form()] = "",
    started_at: Annotated[str, Form()] = "",
    hemisphere: Annotated[str, Form()] = "",
    beta_unit: Annotated[str, Form()] = "",
    beta_source: Annotated[str, Form()] = "",
    lfp_unit: Annotated[str, Form()] = "",
    session: Annotated[str, Form()] = "",
) -> HTMLResponse:
    """Take files without JavaScript, all as one upload; the answer names every file's fate. Sending again changes nothing."""
    typed = {"visit": visit, "controller": controller, "policy": policy, "started_at": started_at, "hemisphere": hemisphere}
    typed |= {"beta_unit": beta_unit, "beta_source": beta_source, "lfp_unit": lfp_unit, "session": session}
    try:
        form = parse(_PageForm, typed, _LABELS)
        # a controller without a visit is taken for what it says, and confirmed with the visit that the date proposes
        counts = form.visit is not None
        stated = service.state_session(
            db, participant, form.visit, form.controller, form.policy or None, form.started_at, form.hemisphere, counts, form.session
        )
        chosen = [Incoming(f.filename or "file", f.file) for f in file or () if f.filename]
        if not chosen:
            raise Invalid("No file was chosen.", "Choose at least one file.", field="file")
        beta = BetaStated(form.beta_unit, form.beta_source, form.lfp_unit)
        outcome = service.receive(db, participant, stated, chosen, caller, beta)
    except BetaloopError as error:
        if passing(error) is not None:
            raise  # without a database, or room for it, there is no page to show it on
        db.rollback()
        return _page(request, db, participant, typed, None, error)
    return _page(request, db, participant, typed, outcome)


@router.get("/participants/{code}/upload/progress")
def upload_progress(participant: CurrentParticipant, db: Db) -> list[dict[str, Any]]:
    """Report the progress of the uploads of a participant that this process is reading, oldest first: for the page, while it waits for an
    answer."""
    return [
        {"upload": number, "share": found.share, "text": wording.progress(found.file, found.files, found.share, found.doing)}
        for number in repository.received_uploads(db, participant.id)
        if (found := told(number)) is not None
    ]


@router.get("/uploads/{upload_id}")
def report(request: Request, upload_id: RowId, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the results of the files of one upload."""
    row, participant = repository.upload(db, upload_id, caller)
    outcome = UploadOutcome(row, participant, service.stored_outcomes(db, row))
    waiting = {s.id for s in study.proposals_of_participant(db, participant.id)} & set(outcome.session_ids)
    why = why_left(participant) if row.status == "received" and row.id not in coming(db) else None
    said = {"waiting": len(waiting), "left": wording.left(why) if why else None, "kind_names": wording.KIND_NAMES}
    return HTMLResponse(render(request, "ingest/report.html", participant=participant, outcome=outcome, **said))


def _state(upload: Upload, coming_in: set[int], left: bool) -> tuple[str, str]:
    """Describe the state of an upload in a few words, and their tone; `coming_in` are those that some web service is receiving.

    Args:
        left: whether what was cut short is not read, for the participant has withdrawn, or the site or study has ended.
    """
    if upload.status == "decoded":
        return "read", "good"
    if any(f.preview is not None for f in upload.files):
        return "columns not known", "warn"
    if upload.status == "failed":
        return "not usable", "bad"
    found = told(upload.id)
    if found is None and upload.id in coming_in:
        return wording.COMING, "info"
    if found is None:
        return (wording.LEFT if left else wording.WAITS), "warn"
    return wording.progress(found.file, found.files, found.share, found.doing), "info"


def _page(
    request: Request,
    db: Session,
    participant: Participant,
    typed: dict[str, str],
    outcome: UploadOutcome | None = None,
    error: BetaloopError | None = None,
) -> HTMLResponse:
    visits, _ = study.visits(db, participant.id, 1000, 0)
    uploads = repository.uploads_of_participant(db, participant.id)
    coming_in = coming(db) if any(u.status == "received" for u in uploads) else set()
    left = why_left(participant) is not None
    known = dict.fromkeys(_LABELS, "") | typed
    page = render(
        request,
        "ingest/upload.html",
        participant=participant,
        visits=visits,
        controllers=[("", "propose from the files"), *((c.value, name) for c, name in CONTROLLER_NAMES.items())],
        sources=[("", "as in the settings"), *((s, label) for s, label in SOURCES if s in get_args(BetaSource))],
        policies=study.policy_names(db, participant.id),
        typed=known,
        outcome=outcome,
        kind_names=wording.KIND_NAMES,
        sessions=study.sessions_of_participant(db, participant.id, with_proposals=True),
        proposed=len(study.proposals_of_participant(db, participant.id)),
        held=sum(f.quarantine_sha256 is not None for f in repository.quarantined_files(db, participant.id)),
        uploads=[(u, _state(u, coming_in, left)) for u in uploads],
        limit_mb=get_settings().upload_limit_mb,
        remarks=field_notes(error, known),
        problem=error.problem(request.url.path) if error else None,
    )
    unusable = outcome is not None and not outcome.usable
    return HTMLResponse(page, error.status if error else 422 if unusable else 200)
