"""HTML page of enrolment."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, confirmed, field_notes, parse
from app.platform.web.templates import render
from app.study import repository
from app.study.enrolment import service
from app.study.enrolment.schemas import ParticipantIn
from app.study.settings import form
from app.study.settings.schemas import SettingsIn

router = APIRouter()

_LABELS = {"code": "Code (letters, digits, - and _)", "site": "Site", "is_study_code": "This is a study code"}


@router.get("/participants/new")
def new_participant(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """The enrolment form."""
    caller.require(can.WRITE_STUDY)
    return _enrolment(request, db, caller, dict.fromkeys(_LABELS, ""), form.texts(SettingsIn()))


@router.post("/participants")
def enrol(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Enrol a participant."""
    known = {name: str(values.get(name, "")).strip() for name in _LABELS}
    try:
        draft = parse(ParticipantIn, {k: v for k, v in known.items() if v}, _LABELS)
        draft.settings = parse(SettingsIn, values, form.LABELS)
        answered = confirmed(values, {"cdbs_amplitude_ma": str(values.get("cdbs_amplitude_ma", ""))})
        draft.sure = ["cdbs_amplitude_ma"] if answered else []
        participant = service.enrol(db, draft, caller)
    except BetaloopError as error:
        db.rollback()
        return _enrolment(request, db, caller, known, _typed(values, form.texts(SettingsIn())), error)
    return RedirectResponse(f"/participants/{participant.code}?done=enrolled", 303)


def _enrolment(
    request: Request, db: Session, caller: Caller, known: dict[str, str], values: dict[str, str], error: BetaloopError | None = None
) -> HTMLResponse:
    sites = [s for s in repository.sites(db, caller) if caller.may(can.WRITE_STUDY, s.study_id, s.id) and s.ended_at is None]
    page = render(
        request,
        "study/participant_new.html",
        known=known,
        values=values,
        stated=form.AT_ENROLMENT,
        constants=form.LATER,
        sites=[(service.in_study(s), s.name, s.study.name) for s in sites],
        prefixes=sorted({(s.study.name, s.study.code_prefix) for s in sites if s.study.code_prefix}),
        questioned=bool(error and any("field" not in q for q in error.extra.get("questions", ()))),
        remarks=field_notes(error, known | values),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)


def _typed(values: FormData, base: dict[str, str]) -> dict[str, str]:
    """What the person typed, so that a refused form comes back as it was sent."""
    return {name: str(values.get(name, text)) for name, text in base.items()}
