"""Every query of a sign-on."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session, selectinload

from app.tables.accounts import SignIn, SignOnLink, User


def link_of(db: Session, issuer: str, subject: str) -> SignOnLink | None:
    """Find the link of a subject at a provider, with its user."""
    mine = (SignOnLink.issuer == issuer) & (SignOnLink.subject == subject)
    return db.scalar(select(SignOnLink).where(mine).options(selectinload(SignOnLink.user).selectinload(User.memberships)))


def use_login(db: Session, link: SignOnLink, at: datetime) -> bool:
    """Note that a login, made at the provider at `at`, was shown here; whether it is newer than all that were. Two show not the same."""
    newer = (SignOnLink.id == link.id) & (SignOnLink.last_used_at.is_(None) | (SignOnLink.last_used_at < at))
    return db.scalar(update(SignOnLink).where(newer).values(last_used_at=at).returning(SignOnLink.id)) is not None


def link_of_user(db: Session, user_id: int, issuer: str) -> SignOnLink | None:
    """Find the link of a user at a provider."""
    return db.scalar(select(SignOnLink).where(SignOnLink.user_id == user_id, SignOnLink.issuer == issuer))


def remove_links(db: Session, user_id: int) -> int:
    """Remove a user's links at every provider; how many there were."""
    return len(db.scalars(delete(SignOnLink).where(SignOnLink.user_id == user_id).returning(SignOnLink.id)).all())


def take_confirmation(db: Session, sign_in_id: int, user_id: int, since: datetime) -> bool:
    """Take back the confirmation that a live browser session was given after `since`; whether there was one. Two take not the same."""
    mine = (SignIn.id == sign_in_id) & (SignIn.user_id == user_id) & SignIn.ended_at.is_(None) & (SignIn.confirmed_at > since)
    return db.scalar(update(SignIn).where(mine).values(confirmed_at=None).returning(SignIn.id)) is not None
