"""Every query of people and access."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from datetime import datetime, timedelta

from sqlalchemy import delete, func, select, text, update
from sqlalchemy.orm import InstrumentedAttribute, Session, joinedload, selectinload
from sqlalchemy.orm.interfaces import LoaderOption

from app.platform.database import now
from app.tables.accounts import ApiToken, Membership, Role, SignIn, SignInAttempt, SignOnLink, Site, Study, User

# E-mail addresses as users type them: one spelling under which they are stored, looked up and counted.

LONGEST_ADDRESS = 254
"""RFC 5321, 4.5.3.1.3: a path of 256 octets, less its brackets."""


def normal_address(email: str) -> str | None:
    """Normalise an address to its one spelling; None for what no address can be.

    Outer white space goes, look-alike forms become one (NFKC), capitals and small letters count as the same. An address with control,
    invisible or unassigned characters, or of more than 254 characters, is none.
    """
    folded = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", email).strip().casefold()).lower().strip()
    if not folded or len(folded) > LONGEST_ADDRESS or any(unicodedata.category(c).startswith("C") for c in folded):
        return None
    return folded


def user_by_email(db: Session, email: str) -> User | None:
    """Find the user of an address, however it is typed; None for what no address can be."""
    address = normal_address(email)
    if address is None:
        return None
    return db.scalar(select(User).where(User.email == address))


def some_password_hash(db: Session, address: str) -> str | None:
    """Return the hash of some user's password, for an address always the same user's; None where there is no user."""
    return db.scalar(select(User.password_hash).order_by(func.md5(func.concat(User.id, " ", address))).limit(1))


def users(db: Session) -> Sequence[User]:
    """List all users with their memberships, by address."""
    return db.scalars(select(User).options(selectinload(User.memberships)).order_by(User.email)).all()


def has_users(db: Session) -> bool:
    """Return whether any account exists."""
    return db.scalar(select(User.id).limit(1)) is not None


def studies(db: Session) -> Sequence[Study]:
    """List all studies, oldest first."""
    return db.scalars(select(Study).order_by(Study.id)).all()


def sign_in_by_token(db: Session, token_sha256: str, idle_since: datetime, begun_since: datetime) -> SignIn | None:
    """Find the live browser session of a token."""
    live = select(SignIn).where(SignIn.token_sha256 == token_sha256, SignIn.ended_at.is_(None))
    live = live.where(SignIn.last_seen_at > idle_since, SignIn.created_at > begun_since)
    return db.scalars(live.options(_with_memberships(SignIn.user))).unique().one_or_none()


def sign_in_of(db: Session, token_sha256: str) -> SignIn | None:
    """Find the browser session of a token, live or not."""
    return db.scalar(select(SignIn).where(SignIn.token_sha256 == token_sha256))


def open_sign_ins(db: Session, user_id: int) -> Sequence[SignIn]:
    """List a user's browser sessions that have not been ended."""
    return db.scalars(select(SignIn).where(SignIn.user_id == user_id, SignIn.ended_at.is_(None))).all()


def api_token_by_hash(db: Session, token_sha256: str) -> ApiToken | None:
    """Find the API token of a hash, unless it was revoked or has run out."""
    live = select(ApiToken).where(ApiToken.token_sha256 == token_sha256, ApiToken.revoked_at.is_(None), ApiToken.expires_at > now())
    return db.scalars(live.options(_with_memberships(ApiToken.user))).unique().one_or_none()


def _with_memberships(user: InstrumentedAttribute[User]) -> LoaderOption:
    """Load a row's user with the roles in the row's own query: every request asks it."""
    return joinedload(user, innerjoin=True).joinedload(User.memberships)


def tokens_of(db: Session, user_id: int) -> Sequence[ApiToken]:
    """List a user's API tokens, newest first."""
    return db.scalars(select(ApiToken).where(ApiToken.user_id == user_id).order_by(ApiToken.created_at.desc())).all()


def token_by_name(db: Session, user_id: int, name: str) -> ApiToken | None:
    """Find a user's token by its name, revoked or not."""
    return db.scalar(select(ApiToken).where(ApiToken.user_id == user_id, ApiToken.name == name))


def sign_on_links(db: Session, user_id: int) -> Sequence[SignOnLink]:
    """List a user's identities at identity providers, oldest first."""
    return db.scalars(select(SignOnLink).where(SignOnLink.user_id == user_id).order_by(SignOnLink.id)).all()


def recent_tries(db: Session, email: str, failed_within: timedelta, undecided_within: timedelta) -> tuple[int, int]:
    """Count the tries of an address: how many failed within a span, and how many of a shorter one are undecided."""
    moment = now()
    failed = func.count().filter(SignInAttempt.failed, SignInAttempt.at > moment - failed_within)
    undecided = func.count().filter(~SignInAttempt.failed, SignInAttempt.at > moment - undecided_within)
    counted = db.execute(select(failed, undecided).where(SignInAttempt.email == email)).one()
    return counted[0], counted[1]


def mark_failed(db: Session, attempt: SignInAttempt) -> None:
    """Decide that a try was wrong; nothing is left to decide where a right one has dropped it meanwhile."""
    db.execute(update(SignInAttempt).where(SignInAttempt.id == attempt.id).values(failed=True))


def lock_address(db: Session, email: str) -> None:
    """Let one transaction at a time count the tries of an address."""
    db.execute(text("select pg_advisory_xact_lock(hashtextextended(:key, 0))"), {"key": f"sign-in:{email}"})


def prune_failures(db: Session, older_than: timedelta) -> None:
    """Remove tries of every address that count no more; those that another transaction removes are left to it."""
    old = select(SignInAttempt.id).where(SignInAttempt.at <= now() - older_than).with_for_update(skip_locked=True)
    db.execute(delete(SignInAttempt).where(SignInAttempt.id.in_(old)))


def forget_failures(db: Session, attempt: SignInAttempt) -> None:
    """Drop a try that was right, and the failures of its address before it."""
    db.execute(delete(SignInAttempt).where(SignInAttempt.email == attempt.email, SignInAttempt.id <= attempt.id))


def site_by_code(db: Session, study_id: int, code: str) -> Site | None:
    """Find a study's site by its code."""
    return db.scalar(select(Site).where(Site.study_id == study_id, Site.code == code))


def roles_of(db: Session, user_id: int, study_id: int) -> Sequence[tuple[Role, str | None]]:
    """List a user's roles in a study, each with the code of its site; None is all sites, which come first."""
    query = select(Membership.role, Site.code).outerjoin(Site, Site.id == Membership.site_id)
    mine = query.where(Membership.user_id == user_id, Membership.study_id == study_id).order_by(Site.code.nulls_first())
    return [(Role(role), code) for role, code in db.execute(mine)]
