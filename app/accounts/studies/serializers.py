"""Rows of studies and sites as API types."""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.accounts.studies import repository
from app.accounts.studies.schemas import SiteOut, StudyOut
from app.tables.accounts import Site, Study


def study_out(db: Session, study: Study) -> StudyOut:
    """Convert a study with its sites."""
    sites = [site_out(s) for s in repository.sites_of(db, study.id)]
    return StudyOut(code=study.code, name=study.name, code_prefix=study.code_prefix, ended_at=study.ended_at, sites=sites)


def site_out(site: Site) -> SiteOut:
    """Convert a site."""
    return SiteOut(code=site.code, name=site.name, ended_at=site.ended_at)
