"""HTML page of enrolment."""

from __future__ import annotations

from typing import Annotated, cast, get_args

from fastapi import APIRouter, Path, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts import permissions as can
from app.accounts import studies
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.accounts.studies import EndingReason, SiteOut, StudyOut, site_out, study_out
from app.accounts.studies_web import ManagedStudy, changed, reason_of
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import FormValues, confirmed, field_notes, parse
from app.platform.web.schemas import problems
from app.platform.web.templates import render
from app.study import participation, repository, settings_form
from app.study.deps import CurrentParticipant
from app.study.participation import ParticipantIn, Status, StatusChange
from app.study.routes.serializers import participant_out
from app.study.schemas import ParticipantOut
from app.study.settings_form import texts
from app.study.settings_types import SettingsIn
from app.study.settings_web import settings_page

pages = APIRouter()

_LABELS = {
    "code": "Code (letters, digits, - and _)",
    "site": "Site",
    "is_study_code": "This is a study code",
    "synthetic": "Synthetic participant",
}


@pages.get("/participants/new")
def new_participant(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the enrolment form."""
    caller.require(can.WRITE_STUDY)
    return _enrolment(request, db, caller, dict.fromkeys(_LABELS, ""), settings_form.texts(SettingsIn()))


@pages.post("/participants")
def enrol(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Enrol a participant."""
    known = {name: str(values.get(name, "")).strip() for name in _LABELS}
    try:
        draft = parse(ParticipantIn, {k: v for k, v in known.items() if v}, _LABELS)
        draft.settings = parse(SettingsIn, values, settings_form.LABELS)
        answered = confirmed(values, {"cdbs_amplitude_ma": str(values.get("cdbs_amplitude_ma", ""))})
        draft.sure = ["cdbs_amplitude_ma"] if answered else []
        participant = participation.enrol(db, draft, caller)
    except BetaloopError as error:
        db.rollback()
        return _enrolment(request, db, caller, known, _typed(values, settings_form.texts(SettingsIn())), error)
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
        stated=settings_form.AT_ENROLMENT,
        constants=settings_form.LATER,
        sites=[(participation.in_study(s), s.name, s.study.name) for s in sites],
        prefixes=sorted({(s.study.name, s.study.code_prefix) for s in sites if s.study.code_prefix}),
        questioned=bool(error and any("field" not in q for q in error.extra.get("questions", ()))),
        remarks=field_notes(error, known | values),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)


def _typed(values: FormData, base: dict[str, str]) -> dict[str, str]:
    """Return what the person typed, so that a refused form comes back as it was sent."""
    return {name: str(values.get(name, text)) for name, text in base.items()}


# REST route of taking part.

api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@api.patch("/participants/{code}")
def change_status(participant: CurrentParticipant, change: StatusChange, db: Db, caller: CurrentCaller) -> ParticipantOut:
    """Say that a participant has completed the study, has withdrawn, or takes part again; a withdrawal cancels running jobs."""
    participation.change_status(db, participant, change, caller)
    return participant_out(participant)


# The form that says whether a participant takes part, on the page of settings.


@pages.post("/participants/{code}/status")
def change_status_by_form(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Change it, with a reason."""
    typed = {name: str(values.get(name, "")).strip() for name in ("status", "status_reason")}
    try:
        participation.change_status(db, participant, _change(typed), caller)
    except BetaloopError as error:
        db.rollback()
        return settings_page(request, db, participant, caller, texts(participant.current_settings), error, taking_part=typed)
    return RedirectResponse(f"/participants/{participant.code}/settings?done=status", 303)


def _change(typed: dict[str, str]) -> StatusChange:
    """Parse the form to the API's type. Raises Invalid, naming the field."""
    status, reason = typed["status"], typed["status_reason"]
    if status not in get_args(Status):
        raise Invalid("Choose whether the participant takes part.", f"Known: {', '.join(get_args(Status))}.", field="status")
    if not reason or len(reason) > 1000:
        hint = "Say why this changes; the audit trail keeps it."
        raise Invalid("There is no reason, or it has more than 1000 characters.", hint, field="status_reason")
    return StatusChange(status=cast(Status, status), reason=reason)


# REST routes of ending studies and sites.

closing_api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 409, 422))

SiteCode = Annotated[str, Path(max_length=40, pattern=r"^[^\x00]*$")]


@closing_api.post("/studies/{study_code}/end")
def end_study(study: ManagedStudy, why: EndingReason, db: Db, caller: CurrentCaller) -> StudyOut:
    """End a study: it is read and exported, and nothing in it changes; its jobs that run are cancelled."""
    participation.end_study(db, study, why.reason, caller)
    return study_out(db, study)


@closing_api.post("/studies/{study_code}/reopen")
def reopen_study(study: ManagedStudy, why: EndingReason, db: Db) -> StudyOut:
    """Open a study that has ended."""
    participation.reopen_study(db, study, why.reason)
    return study_out(db, study)


@closing_api.post("/studies/{study_code}/sites/{site_code}/end")
def end_site(study: ManagedStudy, site_code: SiteCode, why: EndingReason, db: Db) -> SiteOut:
    """End a site: it takes neither enrolments nor uploads; what is there goes on."""
    participation.end_site(db, study, site_code, why.reason)
    return site_out(studies.site_of(db, study, site_code))


@closing_api.post("/studies/{study_code}/sites/{site_code}/reopen")
def reopen_site(study: ManagedStudy, site_code: SiteCode, why: EndingReason, db: Db) -> SiteOut:
    """Open a site that has ended."""
    participation.reopen_site(db, study, site_code, why.reason)
    return site_out(studies.site_of(db, study, site_code))


# The forms that end a study or a site, and open it again; they are on the page of studies.


@pages.post("/studies/{study_code}/end")
def end_study_by_form(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """End a study."""

    def change() -> None:
        participation.end_study(db, studies.study_to_manage(db, study_code, caller), reason_of(values), caller)

    return changed(request, db, caller, "study-ended", change)


@pages.post("/studies/{study_code}/reopen")
def reopen_study_by_form(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Open a study again."""

    def change() -> None:
        participation.reopen_study(db, studies.study_to_manage(db, study_code, caller), reason_of(values))

    return changed(request, db, caller, "reopened", change)


@pages.post("/studies/{study_code}/sites/{site_code}/end")
def end_site_by_form(request: Request, study_code: str, site_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """End a site."""

    def change() -> None:
        participation.end_site(db, studies.study_to_manage(db, study_code, caller), site_code, reason_of(values))

    return changed(request, db, caller, "site-ended", change)


@pages.post("/studies/{study_code}/sites/{site_code}/reopen")
def reopen_site_by_form(request: Request, study_code: str, site_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Open a site again."""

    def change() -> None:
        participation.reopen_site(db, studies.study_to_manage(db, study_code, caller), site_code, reason_of(values))

    return changed(request, db, caller, "reopened", change)
