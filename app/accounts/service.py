"""Rules of accounts: passwords (argon2), browser sessions kept on the server, API tokens, lock-out after failures."""

from __future__ import annotations

import hashlib
import re
import secrets
from datetime import timedelta
from functools import lru_cache

from pwdlib import PasswordHash
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts import repository
from app.accounts.models import ApiToken, Membership, Role, SignIn, SignInAttempt, Study, User
from app.accounts.permissions import MANAGE_ACCOUNTS, PERMISSIONS, READ_AUDIT, Caller, Grant
from app.platform.database import now
from app.platform.errors import Conflict, Forbidden, Invalid, NotFound, TooMany, Unauthorized
from app.settings import get_settings

MIN_PASSWORD = 10
FAILURES_ALLOWED = 5
FAILURE_WINDOW = timedelta(minutes=15)
_SEEN_RESOLUTION = timedelta(minutes=1)
_TOKEN_PREFIX = "blp_"

_hasher = PasswordHash.recommended()


@lru_cache(maxsize=1)
def _decoy() -> str:
    """Hash of a password that nobody has."""
    return _hasher.hash(secrets.token_hex(16))


def add_user(db: Session, email: str, role: Role, password: str, study_code: str | None = None, name: str = "") -> User:
    """Make a user with a role in a study (the only one, unless named)."""
    email = email.strip().lower()
    if not re.fullmatch(r"[^@\s]+@[^@\s]+", email) or len(email) > 254:
        raise Invalid(f"'{email}' is no e-mail address.", "Give one like name@clinic.example.")
    if repository.user_by_email(db, email):
        raise Conflict(f"There is already a user {email}.")
    check_password(password)
    user = User(email=email, name=name, password_hash=_hasher.hash(password))
    user.memberships.append(Membership(study_id=study_of(db, study_code).id, role=role))
    db.add(user)
    db.flush()
    return user


def check_password(password: str) -> None:
    """Raises Invalid for a password that is too short."""
    if len(password) < MIN_PASSWORD:
        raise Invalid(f"The password has {len(password)} characters.", f"Use at least {MIN_PASSWORD}.")


def set_password(db: Session, user: User, password: str) -> None:
    """Change a password and end every browser session of the user."""
    check_password(password)
    user.password_hash = _hasher.hash(password)
    for sign_in in db.scalars(select(SignIn).where(SignIn.user_id == user.id, SignIn.ended_at.is_(None))):
        sign_in.ended_at = now()


def change_own_password(db: Session, user_id: int, present: str, new: str) -> None:
    """Change a password by its owner, who proves to know the present one. Raises Forbidden when it is wrong, Invalid for a bad new one."""
    user = db.get_one(User, user_id)
    if not _hasher.verify(present, user.password_hash):
        raise Forbidden("The present password is wrong.", "Nothing was changed; try again.")
    set_password(db, user, new)


def administers(caller: Caller, study_id: int, site_id: int | None = None) -> bool:
    """Whether the caller may manage accounts of a site, or (site_id None) of a whole study."""
    return caller.is_system or any(
        MANAGE_ACCOUNTS in PERMISSIONS[g.role] and g.study_id == study_id and g.site_id in (None, site_id) for g in caller.grants
    )


def manages(caller: Caller, user: User) -> bool:
    """Whether the caller administers everything that the user has access to."""
    return all(administers(caller, m.study_id, m.site_id) for m in user.memberships)


def reads_whole_audit(db: Session, caller: Caller) -> bool:
    """Whether the caller may read the audit trail, whose rows belong to no study: a grant over every study, at all of its sites."""
    whole = {g.study_id for g in caller.grants if READ_AUDIT in PERMISSIONS[g.role] and g.site_id is None}
    return caller.is_system or all(study.id in whole for study in repository.studies(db))


def set_active(db: Session, user: User, active: bool, caller: Caller) -> None:
    """Shut a user out at once, or let the user in again. Raises Invalid for oneself."""
    if user.id == caller.user_id:
        raise Invalid("You cannot close your own account.", "Ask another administrator.")
    user.active = active
    db.flush()


def sign_in(db: Session, email: str, password: str) -> str:
    """Check a password and open a browser session; returns the cookie's token.

    The caller commits also when this raises, so that failures count.

    Raises:
        TooMany: too many failures of this address lately. Unauthorized: wrong address or password.
    """
    email = email.strip().lower().replace("\0", "")[:254]
    if repository.recent_failures(db, email, FAILURE_WINDOW) >= FAILURES_ALLOWED:
        raise TooMany(f"Too many failed sign-ins for {email}.", f"Wait {FAILURE_WINDOW.seconds // 60} minutes and try again.")
    user = repository.user_by_email(db, email)
    # an unknown address costs the same time as a wrong password, so that addresses cannot be guessed by the clock
    ok = _hasher.verify(password, user.password_hash if user else _decoy())
    if not (ok and user and user.active):
        db.add(SignInAttempt(email=email))
        raise Unauthorized("The e-mail address or the password is wrong.")
    repository.forget_failures(db, email)
    token = secrets.token_urlsafe(32)
    db.add(SignIn(token_sha256=_hash(token), user_id=user.id))
    return token


def sign_out(db: Session, token: str) -> None:
    """End a browser session."""
    row = db.scalar(select(SignIn).where(SignIn.token_sha256 == _hash(token)))
    if row and row.ended_at is None:
        row.ended_at = now()


def caller_of_cookie(db: Session, token: str) -> Caller | None:
    """Who the cookie's token belongs to, unless the session idled out or ended."""
    settings = get_settings()
    row = repository.sign_in_by_token(
        db, _hash(token), now() - timedelta(minutes=settings.session_idle_minutes), now() - timedelta(hours=settings.session_max_hours)
    )
    if row is None or not row.user.active:
        return None
    if now() - row.last_seen_at > _SEEN_RESOLUTION:
        row.last_seen_at = now()
        db.commit()
    return caller_of(row.user)


def caller_of_token(db: Session, token: str) -> Caller | None:
    """Who an API token belongs to, unless it was revoked."""
    row = repository.api_token_by_hash(db, _hash(token))
    if row is None or not row.user.active:
        return None
    if row.last_used_at is None or now() - row.last_used_at > _SEEN_RESOLUTION:
        row.last_used_at = now()
        db.commit()
    return caller_of(row.user)


def caller_of(user: User) -> Caller:
    """A user as an acting caller."""
    return Caller(user.email, user.id, tuple(Grant(m.study_id, m.site_id, Role(m.role)) for m in user.memberships))


def create_token(db: Session, email: str, name: str) -> str:
    """Make an API token and return it; it is shown this once."""
    user = repository.user_by_email(db, email)
    if user is None:
        raise NotFound(f"There is no user {email}.", "Make one with `betaloop user add`.")
    name = name.strip()
    if not name or len(name) > 100:
        raise Invalid("A token needs a name of 1-100 characters.", "Name it after what will use it, e.g. 'upload-tablet'.")
    if repository.token_by_name(db, user.id, name):
        raise Conflict(f"{email} already has a token named '{name}'.", "Choose another name.")
    token = _TOKEN_PREFIX + secrets.token_urlsafe(32)
    db.add(ApiToken(user_id=user.id, name=name, token_sha256=_hash(token)))
    db.flush()
    return token


def revoke_token(db: Session, user_id: int, token_id: int) -> None:
    """End an API token of this user."""
    row = db.get(ApiToken, token_id)
    if row is None or row.user_id != user_id:
        raise NotFound("You have no such token.")
    row.revoked_at = row.revoked_at or now()


def study_of(db: Session, code: str | None) -> Study:
    """The study of a code, or the only one. Raises NotFound naming those there are."""
    query = select(Study).order_by(Study.id)
    studies = db.scalars(query if code is None else query.where(Study.code == code)).all()
    if len(studies) != 1:
        known = ", ".join(s.code for s in db.scalars(select(Study).order_by(Study.id)))
        raise NotFound(f"Which study? Known: {known}.", "Name one.")
    return studies[0]


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
