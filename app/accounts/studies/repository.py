"""Every query of studies, sites and memberships."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.models import Membership, Site, Study


def study_by_code(db: Session, code: str) -> Study | None:
    """The study of a code."""
    return db.scalar(select(Study).where(Study.code == code))


def sites_of(db: Session, study_id: int) -> Sequence[Site]:
    """A study's sites by code."""
    return db.scalars(select(Site).where(Site.study_id == study_id).order_by(Site.code)).all()


def site_by_code(db: Session, study_id: int, code: str) -> Site | None:
    """A study's site by its code."""
    return db.scalar(select(Site).where(Site.study_id == study_id, Site.code == code))


def membership(db: Session, user_id: int, study_id: int, site_id: int | None) -> Membership | None:
    """A user's role in a study, at one site or (None) at all of them; locked, so that two changes wait for each other."""
    mine = (Membership.user_id == user_id) & (Membership.study_id == study_id) & Membership.site_id.is_not_distinct_from(site_id)
    return db.scalar(select(Membership).where(mine).with_for_update())
