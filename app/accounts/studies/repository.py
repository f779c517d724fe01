"""Every query of studies, sites and memberships."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from app.tables.accounts import Membership, Site, Study, User
from app.tables.participants import Participant


def study_by_code(db: Session, code: str) -> Study | None:
    """Find the study of a code."""
    return db.scalar(select(Study).where(Study.code == code))


def sites_of(db: Session, study_id: int) -> Sequence[Site]:
    """List a study's sites by code."""
    return db.scalars(select(Site).where(Site.study_id == study_id).order_by(Site.code)).all()


def members_of(db: Session, study_id: int) -> Sequence[tuple[User, Membership, str | None]]:
    """List who works in a study, by address: the user, the role, and the code of the site, None for all sites."""
    query = (
        select(User, Membership, Site.code).join(Membership, Membership.user_id == User.id).outerjoin(Site, Site.id == Membership.site_id)
    )
    rows = db.execute(query.where(Membership.study_id == study_id).order_by(User.email, Site.code)).all()
    return [(user, member, code) for user, member, code in rows]


def lock_codes(db: Session, *, exclusively: bool) -> None:
    """Lock participants' codes until the transaction ends: any number may enrol at once, and none while a prefix is claimed."""
    shared = "" if exclusively else "_shared"
    db.execute(text(f"select pg_advisory_xact_lock{shared}(hashtextextended('participant-codes', 0))"))


def prefixes(db: Session) -> Sequence[tuple[int, str, str]]:
    """List number and code of every study with a prefix, and the prefix, as they are in the database now."""
    rows = db.execute(select(Study.id, Study.code, Study.code_prefix).where(Study.code_prefix.is_not(None))).all()
    return [(number, code, prefix) for number, code, prefix in rows if prefix]


def codes_elsewhere(db: Session, study_id: int, prefix: str) -> bool:
    """Decide whether a participant of another study has a code that begins so, whatever its capitals."""
    begins = func.lower(Participant.code).startswith(prefix.lower(), autoescape=True)
    query = select(Participant.code).join(Site, Site.id == Participant.site_id).where(Site.study_id != study_id, begins)
    return db.scalar(query.limit(1)) is not None


def membership(db: Session, user_id: int, study_id: int, site_id: int | None) -> Membership | None:
    """Find a user's role in a study, at one site or (None) at all of them; locked, so that two changes wait for each other."""
    mine = (Membership.user_id == user_id) & (Membership.study_id == study_id) & Membership.site_id.is_not_distinct_from(site_id)
    return db.scalar(select(Membership).where(mine).with_for_update(of=Membership))
