"""Every query of people and access."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session, selectinload

from app.accounts.models import ApiToken, SignIn, SignInAttempt, Study, User
from app.platform.database import now


def user_by_email(db: Session, email: str) -> User | None:
    """The user of an address, in any case of letters."""
    return db.scalar(select(User).where(User.email == email.strip().lower()))


def users(db: Session) -> Sequence[User]:
    """All users with their memberships, by address."""
    return db.scalars(select(User).options(selectinload(User.memberships)).order_by(User.email)).all()


def studies(db: Session) -> Sequence[Study]:
    """All studies, oldest first."""
    return db.scalars(select(Study).order_by(Study.id)).all()


def sign_in_by_token(db: Session, token_sha256: str, idle_since: datetime, begun_since: datetime) -> SignIn | None:
    """The live browser session of a token."""
    return db.scalar(
        select(SignIn)
        .where(SignIn.token_sha256 == token_sha256, SignIn.ended_at.is_(None))
        .where(SignIn.last_seen_at > idle_since, SignIn.created_at > begun_since)
        .options(selectinload(SignIn.user).selectinload(User.memberships))
    )


def sign_in_of(db: Session, token_sha256: str) -> SignIn | None:
    """The browser session of a token, live or not."""
    return db.scalar(select(SignIn).where(SignIn.token_sha256 == token_sha256))


def open_sign_ins(db: Session, user_id: int) -> Sequence[SignIn]:
    """A user's browser sessions that nobody has ended."""
    return db.scalars(select(SignIn).where(SignIn.user_id == user_id, SignIn.ended_at.is_(None))).all()


def api_token_by_hash(db: Session, token_sha256: str) -> ApiToken | None:
    """The live API token of a hash."""
    return db.scalar(
        select(ApiToken)
        .where(ApiToken.token_sha256 == token_sha256, ApiToken.revoked_at.is_(None))
        .options(selectinload(ApiToken.user).selectinload(User.memberships))
    )


def tokens_of(db: Session, user_id: int) -> Sequence[ApiToken]:
    """A user's API tokens, newest first."""
    return db.scalars(select(ApiToken).where(ApiToken.user_id == user_id).order_by(ApiToken.created_at.desc())).all()


def token_by_name(db: Session, user_id: int, name: str) -> ApiToken | None:
    """A user's token by its name, revoked or not."""
    return db.scalar(select(ApiToken).where(ApiToken.user_id == user_id, ApiToken.name == name))


def recent_failures(db: Session, email: str, within: timedelta) -> int:
    """Failed sign-ins of an address within a span."""
    recent = (SignInAttempt.email == email) & (SignInAttempt.at > now() - within)
    return db.scalar(select(func.count()).select_from(SignInAttempt).where(recent)) or 0


def forget_failures(db: Session, email: str) -> None:
    """Drop the failures of an address after a good sign-in."""
    db.execute(delete(SignInAttempt).where(SignInAttempt.email == email))
