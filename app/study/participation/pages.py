"""The form that says whether a participant takes part, on the page of settings."""

from __future__ import annotations

from typing import cast, get_args

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.errors import Invalid
from app.platform.web.forms import FormValues
from app.study.deps import CurrentParticipant
from app.study.participation import service
from app.study.participation.schemas import Status, StatusChange

router = APIRouter()


@router.post("/participants/{code}/status")
def change_status(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Change it, with a reason."""
    status, reason = str(values.get("status", "")), str(values.get("status_reason", "")).strip()
    if status not in get_args(Status):
        raise Invalid("Choose whether the participant takes part.", f"Known: {', '.join(get_args(Status))}.")
    if not reason or len(reason) > 1000:
        raise Invalid("There is no reason, or it has more than 1000 characters.", "Say why this changes; the audit trail keeps it.")
    service.change_status(db, participant, StatusChange(status=cast(Status, status), reason=reason), caller)
    db.commit()
    return RedirectResponse(f"/participants/{participant.code}/settings?done=status", 303)
