"""HTML page of a participant's characteristics."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import FormValues, field_notes
from app.platform.web.templates import render
from app.study.access import may
from app.study.characteristics import form, service
from app.study.characteristics.schemas import MOST_DOSES, MOST_LEADS
from app.study.characteristics.words import SYMPTOMS, TARGETS, characteristics_words
from app.study.deps import CurrentParticipant
from app.study.doses.words import DRUG_NAMES
from app.study.form_changes import reason_of
from app.study.settings.form import history_of
from app.tables.participants import Participant

router = APIRouter()


@router.get("/participants/{code}/characteristics")
def characteristics(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Leads, symptoms, hand and medication of a participant, and the versions before."""
    return _page(request, db, participant, caller, form.texts(service.fields_of(participant.current_characteristics)))


@router.post("/participants/{code}/characteristics")
def change_characteristics(
    request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues
) -> Response:
    """Make a new version of what the form says."""
    typed, before = form.posted(values), len(participant.characteristics)
    try:
        wanted, seen = form.characteristics(typed), str(values.get("version", ""))
        if not seen.isdecimal():
            raise Invalid("The form does not say which version it showed.", "Load the page again.")
        service.change_characteristics(db, participant, int(seen), wanted, reason_of(values) or "", caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, participant, caller, typed, error, reason_of(values))
    changed = len(participant.characteristics) != before
    return RedirectResponse(f"/participants/{participant.code}/characteristics?done={'changed' if changed else 'same'}", 303)


def _page(
    request: Request,
    db: Session,
    participant: Participant,
    caller: Caller,
    values: dict[str, str],
    error: BetaloopError | None = None,
    reason: str | None = None,
) -> HTMLResponse:
    current = participant.current_characteristics
    suggested = service.suggested_hand(db, participant)
    page = render(
        request,
        "study/characteristics.html",
        participant=participant,
        current=current,
        values=values,
        reason=reason,
        symptoms=SYMPTOMS,
        targets=TARGETS,
        drugs=DRUG_NAMES,
        leads=range(1, MOST_LEADS + 1),
        doses=range(1, MOST_DOSES + 1),
        shown_leads=form.shown_rows(values, "lead"),
        shown_doses=form.shown_rows(values, "dose"),
        suggested=suggested,
        same_side=bool(current and current.hand and suggested and current.hand != suggested),
        history=history_of([(row, characteristics_words(service.fields_of(row))) for row in participant.characteristics], first_tells=True),
        may_write=may(caller, can.WRITE_STUDY, participant),
        remarks=field_notes(error, values),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
