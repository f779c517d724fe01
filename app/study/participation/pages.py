"""The form that says whether a participant takes part, on the page of settings."""

from __future__ import annotations

from typing import cast, get_args

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import FormValues
from app.study.deps import CurrentParticipant
from app.study.participation import service
from app.study.participation.schemas import Status, StatusChange
from app.study.settings.form import texts
from app.study.settings.pages import settings_page

router = APIRouter()


@router.post("/participants/{code}/status")
def change_status(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Change it, with a reason."""
    typed = {name: str(values.get(name, "")).strip() for name in ("status", "status_reason")}
    try:
        service.change_status(db, participant, _change(typed), caller)
    except BetaloopError as error:
        db.rollback()
        return settings_page(request, db, participant, caller, texts(participant.current_settings), error, taking_part=typed)
    return RedirectResponse(f"/participants/{participant.code}/settings?done=status", 303)


def _change(typed: dict[str, str]) -> StatusChange:
    """The form as the API's type. Raises Invalid, naming the field."""
    status, reason = typed["status"], typed["status_reason"]
    if status not in get_args(Status):
        raise Invalid("Choose whether the participant takes part.", f"Known: {', '.join(get_args(Status))}.", field="status")
    if not reason or len(reason) > 1000:
        hint = "Say why this changes; the audit trail keeps it."
        raise Invalid("There is no reason, or it has more than 1000 characters.", hint, field="status_reason")
    return StatusChange(status=cast(Status, status), reason=reason)
