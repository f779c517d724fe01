"""REST routes of ending studies and sites."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path

from app.accounts import studies
from app.accounts.deps import CurrentCaller
from app.accounts.studies import EndingReason, SiteOut, StudyOut, site_out, study_out
from app.accounts.studies_web import ManagedStudy
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.closing import service

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 409, 422))

SiteCode = Annotated[str, Path(max_length=40, pattern=r"^[^\x00]*$")]


@router.post("/studies/{study_code}/end")
def end_study(study: ManagedStudy, why: EndingReason, db: Db, caller: CurrentCaller) -> StudyOut:
    """End a study: it is read and exported, and nothing in it changes; its jobs that run are cancelled."""
    service.end_study(db, study, why.reason, caller)
    return study_out(db, study)


@router.post("/studies/{study_code}/reopen")
def reopen_study(study: ManagedStudy, why: EndingReason, db: Db) -> StudyOut:
    """Open a study that has ended."""
    service.reopen_study(db, study, why.reason)
    return study_out(db, study)


@router.post("/studies/{study_code}/sites/{site_code}/end")
def end_site(study: ManagedStudy, site_code: SiteCode, why: EndingReason, db: Db) -> SiteOut:
    """End a site: it takes neither enrolments nor uploads; what is there goes on."""
    service.end_site(db, study, site_code, why.reason)
    return site_out(studies.site_of(db, study, site_code))


@router.post("/studies/{study_code}/sites/{site_code}/reopen")
def reopen_site(study: ManagedStudy, site_code: SiteCode, why: EndingReason, db: Db) -> SiteOut:
    """Open a site that has ended."""
    service.reopen_site(db, study, site_code, why.reason)
    return site_out(studies.site_of(db, study, site_code))
