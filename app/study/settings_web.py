"""HTML page of a participant's settings."""

from __future__ import annotations

import structlog
from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import FormValues, confirmed, field_notes, parse
from app.platform.web.templates import render
from app.study import access, settings_form
from app.study import settings as versions
from app.study.access import may
from app.study.deps import CurrentParticipant
from app.study.settings import SuggestedThreshold, suggest_xi_beta
from app.study.settings_form import Shown, own_changes, reason_of
from app.study.settings_types import SettingsIn
from app.tables.participants import Participant

log = structlog.get_logger()

pages = APIRouter()


@pages.get("/participants/{code}/settings")
def settings(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Present settings, with every one explained, and the versions before."""
    return settings_page(request, db, participant, caller, settings_form.texts(participant.current_settings))


@pages.post("/participants/{code}/settings")
def change_settings(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Make a new settings version of what the form changes."""
    before = participant.current_settings.version
    seen = str(values["version"]) if "version" in values else None
    shown = [Shown(v.version, settings_form.texts(v), v.created_by) for v in participant.settings]
    changes = own_changes(values, seen, shown, settings_form.LABELS)
    try:
        access.require(caller, can.WRITE_SETTINGS, participant)
        changes.refuse_conflicts()
        wanted, sure = parse(SettingsIn, changes.fields, settings_form.LABELS), confirmed(values, changes.fields)
        row = versions.change_settings(db, participant, wanted, reason_of(values), caller, sure)
    except BetaloopError as error:
        db.rollback()
        typed = settings_form.texts(participant.current_settings) | changes.fields
        return settings_page(request, db, participant, caller, typed, error, reason=reason_of(values))
    return RedirectResponse(f"/participants/{participant.code}/settings?done={'changed' if row.version != before else 'same'}", 303)


def settings_page(
    request: Request,
    db: Session,
    participant: Participant,
    caller: Caller,
    values: dict[str, str],
    error: BetaloopError | None = None,
    reason: str | None = None,
    taking_part: dict[str, str] | None = None,
) -> HTMLResponse:
    """Render the page; `values` are in its form, `error` says why it was refused. With `taking_part`, the text typed there, the refused
    form is the one on taking part.
    """
    page = render(
        request,
        "study/settings.html",
        participant=participant,
        current=participant.current_settings,
        values=values,
        reason=reason,
        groups=settings_form.GROUPS,
        history=settings_form.history(participant.settings),
        suggestion=_suggestion(db, participant, caller),
        may_write=may(caller, can.WRITE_SETTINGS, participant),
        may_change_status=may(caller, can.WRITE_STUDY, participant),
        problem=error.problem(request.url.path) if error else None,
        taking_part=taking_part or {"status": participant.status, "status_reason": ""},
        remarks=field_notes(error, values if taking_part is None else taking_part),
    )
    return HTMLResponse(page, error.status if error else 200)


def _suggestion(db: Session, participant: Participant, caller: Caller) -> SuggestedThreshold | None:
    try:
        return suggest_xi_beta(db, participant, caller)
    except Invalid as error:
        # the session's own page says what is wrong with it; the settings must stay reachable, for they may be what corrects it
        log.info("no threshold suggested", participant=participant.code, reason=error.detail)
        return None
