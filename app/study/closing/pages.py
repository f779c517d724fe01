"""The forms that end a study or a site, and open it again; they stand on the page of studies."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import Response

from app.accounts import studies
from app.accounts.deps import CurrentCaller
from app.accounts.studies_web import changed, reason_of
from app.platform.database import Db
from app.platform.web.forms import FormValues
from app.study.closing import service

router = APIRouter()


@router.post("/studies/{study_code}/end")
def end_study(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """End a study."""

    def change() -> None:
        service.end_study(db, studies.study_to_manage(db, study_code, caller), reason_of(values), caller)

    return changed(request, db, caller, "study-ended", change)


@router.post("/studies/{study_code}/reopen")
def reopen_study(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Open a study again."""

    def change() -> None:
        service.reopen_study(db, studies.study_to_manage(db, study_code, caller), reason_of(values))

    return changed(request, db, caller, "reopened", change)


@router.post("/studies/{study_code}/sites/{site_code}/end")
def end_site(request: Request, study_code: str, site_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """End a site."""

    def change() -> None:
        service.end_site(db, studies.study_to_manage(db, study_code, caller), site_code, reason_of(values))

    return changed(request, db, caller, "site-ended", change)


@router.post("/studies/{study_code}/sites/{site_code}/reopen")
def reopen_site(request: Request, study_code: str, site_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Open a site again."""

    def change() -> None:
        service.reopen_site(db, studies.study_to_manage(db, study_code, caller), site_code, reason_of(values))

    return changed(request, db, caller, "reopened", change)
