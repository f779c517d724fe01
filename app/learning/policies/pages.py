"""HTML pages of learning: policies, one snapshot."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.learning import repository
from app.learning.deps import CurrentSnapshot
from app.learning.policies import service
from app.learning.policies.uploads import read_limited
from app.learning.schemas import ALGORITHM_NAMES, PolicyLabel
from app.learning.snapshots.coverage import describe
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import field_notes, parse
from app.platform.web.schemas import PagingQuery
from app.platform.web.templates import render
from app.study.access import may
from app.study.deps import CurrentParticipant
from app.tables.participants import Participant

router = APIRouter()

LABELS = {"name": "Name"}


@router.get("/participants/{code}/policies")
def policies_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, paging: PagingQuery) -> HTMLResponse:
    """Show all policies of a participant, and the form for one made elsewhere."""
    return _policies(request, participant, db, caller, paging.limit, paging.offset)


@router.post("/participants/{code}/policies")
def add_policy(
    request: Request,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    name: Annotated[str, Form(max_length=200)] = "",
    file: Annotated[UploadFile | None, File()] = None,
) -> Response:
    """Add a policy made elsewhere."""
    try:
        if file is None or not file.filename:
            raise Invalid("No file was chosen.", "Choose an ONNX file.", field="file")
        label = parse(PolicyLabel, {"name": name}, LABELS).name
        row = service.add_external(db, participant, label, read_limited(file), file.filename, caller)
    except BetaloopError as error:
        db.rollback()
        return _policies(request, participant, db, caller, 50, 0, error, name)
    return RedirectResponse(f"/participants/{participant.code}/policies/{row.id}?done=added", 303)


@router.get("/snapshots/{snapshot_id}")
def snapshot_page(request: Request, snapshot: CurrentSnapshot, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show what a snapshot's buffer covers."""
    participant = db.get_one(Participant, snapshot.participant_id)
    return HTMLResponse(render(request, "learning/snapshot.html", participant=participant, view=describe(db, snapshot, caller)))


def _policies(
    request: Request,
    participant: Participant,
    db: Session,
    caller: Caller,
    limit: int,
    offset: int,
    error: BetaloopError | None = None,
    name: str = "",
) -> HTMLResponse:
    rows, total = repository.policies(db, participant.id, limit, offset)
    snapshots, snapshot_count = repository.snapshots(db, participant.id, 5, 0)
    page = render(
        request,
        "learning/policies.html",
        participant=participant,
        policies=rows,
        total=total,
        limit=limit,
        offset=offset,
        snapshots=snapshots,
        snapshot_count=snapshot_count,
        sweeps=repository.sweeps(db, participant.id, 10, 0)[0],
        algorithm_names=ALGORITHM_NAMES,
        problem=error.problem(request.url.path) if error else None,
        remarks=field_notes(error, {"name": name}),
        name=name,
        window=participant.current_settings.window,
        may_write=may(caller, can.WRITE_POLICIES, participant),
    )
    return HTMLResponse(page, error.status if error else 200)
