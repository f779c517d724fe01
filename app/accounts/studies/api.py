"""REST routes of studies and sites. Roles of people are given by people who have signed in: on the page, or at the command line."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts import repository as accounts
from app.accounts.deps import CurrentCaller
from app.accounts.models import Site, Study
from app.accounts.studies import repository, service
from app.accounts.studies.schemas import NameChange, SiteIn, SiteOut, StudyIn, StudyOut
from app.platform.database import Db
from app.platform.web.schemas import problems

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


def _managed(study_code: str, db: Db, caller: CurrentCaller) -> Study:
    return service.study_to_manage(db, study_code, caller)


ManagedStudy = Annotated[Study, Depends(_managed)]


@router.get("/studies")
def list_studies(db: Db, caller: CurrentCaller) -> list[StudyOut]:
    """The studies that the caller may read, with their sites."""
    return [_study_out(db, s) for s in accounts.studies(db) if caller.may(can.READ, s.id)]


@router.post("/studies", status_code=201, responses=problems(409))
def add_study(draft: StudyIn, db: Db, caller: CurrentCaller) -> StudyOut:
    """Add a study with its first site. Needs an administrator of all studies."""
    study = service.add_study(db, draft, caller)
    db.commit()
    return _study_out(db, study)


@router.patch("/studies/{study_code}")
def rename_study(study: ManagedStudy, change: NameChange, db: Db) -> StudyOut:
    """Give a study another name."""
    service.rename_study(db, study, change.name, change.reason)
    db.commit()
    return _study_out(db, study)


@router.post("/studies/{study_code}/sites", status_code=201, responses=problems(409))
def add_site(study: ManagedStudy, draft: SiteIn, db: Db) -> SiteOut:
    """Add a site to a study."""
    site = service.add_site(db, study, draft)
    db.commit()
    return _site_out(site)


@router.patch("/studies/{study_code}/sites/{site_code}")
def rename_site(study: ManagedStudy, site_code: str, change: NameChange, db: Db) -> SiteOut:
    """Give a site another name."""
    site = service.rename_site(db, study, site_code, change.name, change.reason)
    db.commit()
    return _site_out(site)


def _study_out(db: Session, study: Study) -> StudyOut:
    return StudyOut(code=study.code, name=study.name, sites=[_site_out(s) for s in repository.sites_of(db, study.id)])


def _site_out(site: Site) -> SiteOut:
    return SiteOut(code=site.code, name=site.name)
