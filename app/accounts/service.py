"""Rules of accounts: passwords (argon2), browser sessions kept on the server, API tokens, lock-out after failures."""

from __future__ import annotations

import hashlib
import re
import secrets
from dataclasses import replace
from datetime import timedelta
from functools import lru_cache

from pwdlib import PasswordHash
from sqlalchemy.orm import Session

from app.accounts import repository, second_factor
from app.accounts.passwords import MIN_PASSWORD, FewAtOnce, place, weakness
from app.accounts.permissions import MANAGE_ACCOUNTS, READ_AUDIT, Caller, Grant
from app.accounts.repository import LONGEST_ADDRESS, normal_address
from app.platform.audit import record, record_once
from app.platform.database import now, set_actor, transaction
from app.platform.errors import Conflict, Forbidden, Invalid, NotFound, TooMany, Unauthorized, about
from app.platform.web.sources import in_words
from app.settings import get_settings
from app.tables.accounts import ApiToken, Membership, Role, Scope, SignIn, SignInAttempt, Study, User

FAILURES_ALLOWED = 5
FAILURE_WINDOW = timedelta(minutes=15)
UNDECIDED_WINDOW = timedelta(minutes=1)
"""Time for which a try counts whose verdict is not written. One whose verdict could not be written (the disk of the database is full) gave
its sender none. A check and its wait for others take seconds."""
LOCKED_OUT = {"why": "too many failed tries"}
AT_ONCE = {"why": "too many tries at once"}
TOKEN_DAYS, MOST_TOKEN_DAYS = 90, 730
_SEEN_RESOLUTION = timedelta(minutes=1)
_TOKEN_PREFIX = "blp_"  # noqa: S105 - no secret

# Argon2id with 19 MiB, two passes and one lane: the second of the settings that OWASP's Password Storage Cheat Sheet gives as equally good.
# A check takes 22 ms of a processor; with the library's default (64 MiB, three passes, four lanes) 180, nearly all of what a sign-in costs
_hasher = PasswordHash((FewAtOnce(time_cost=2, memory_cost=19 * 1024, parallelism=1),))


@lru_cache(maxsize=1)
def _decoy() -> str:
    """Make the hash of a password that does not exist, for an installation without users."""
    return _hasher.hash(secrets.token_hex(16))


def add_user(
    db: Session, email: str, role: Role, password: str, study_code: str | None = None, name: str = "", site_code: str | None = None
) -> User:
    """Make a user with a role in a study (the only one, unless named), at one site or at all.

    Raises:
        Invalid: no address, or a weak password. Conflict: the address is taken. NotFound: no such study or site.
    """
    address = normal_address(email)
    if address is None or not re.fullmatch(r"[^@\s]+@[^@\s]+", address):
        raise Invalid(f"{email.strip()[:LONGEST_ADDRESS]!r} is no e-mail address.", "Give one like name@clinic.example.", field="email")
    email = address
    if repository.user_by_email(db, email):
        raise Conflict(f"There is already a user {email}.", field="email")
    check_password(password, email, name)
    with place():
        user = User(email=email, name=name, password_hash=_hasher.hash(password))
    study = study_of(db, study_code)
    site = repository.site_by_code(db, study.id, site_code) if site_code else None
    if site_code and site is None:
        raise NotFound(f"Study '{study.code}' has no site '{site_code}'.", "`betaloop study site` adds one.", field="site")
    user.memberships.append(Membership(study_id=study.id, site_id=site and site.id, role=role))
    db.add(user)
    db.flush()
    return user


def roles_in_words(db: Session, user: User, study: Study) -> str:
    """Describe the roles that a user has in a study, and where they apply."""
    roles = repository.roles_of(db, user.id, study.id)
    if not roles:
        return f"{user.email} has no role in study {study.code} and sees nothing of it."
    parts = [f"{role.value.replace('_', ' ')} at {'all sites' if site is None else f'site {site}'}" for role, site in roles]
    rest = "" if roles[0][1] is None else ", and sees no other site"
    return f"{user.email} is {' and '.join(parts)} of study {study.code}{rest}."


def check_password(password: str, email: str, name: str = "") -> None:
    """Raise Invalid for a password that is too short or too easy to guess, TooMany where too many ask at the same moment."""
    with place():
        why = weakness(password, email, name)
    if why is not None:
        raise Invalid(
            f"The password {why}.",
            f"Use at least {MIN_PASSWORD} characters, such as four words that have nothing to do with each other.",
            field="password",
        )


def set_password(db: Session, user: User, password: str) -> None:
    """Change a password; every browser session and API token of the user ends, for another person may have made them."""
    check_password(password, user.email, user.name)
    with place():
        user.password_hash = _hasher.hash(password)
    for token in repository.tokens_of(db, user.id):
        token.revoked_at = token.revoked_at or now()
    for sign_in in repository.open_sign_ins(db, user.id):
        sign_in.ended_at = now()


def change_own_password(db: Session, user_id: int, present: str, new: str, code: str = "") -> None:
    """Change a password by its owner, who proves to know the present one; tries are counted together with sign-ins, and committed.

    Raises:
        TooMany: too many wrong passwords lately. Forbidden: the present one is wrong. Invalid: a bad new one.
    """
    user = db.get_one(User, user_id)
    check_password(new, user.email, user.name)
    with about("present"):
        confirm_password(user_id, present, code)
    set_password(db, user, new)


def confirm_password(user_id: int, password: str, code: str = "") -> None:
    """Require proof that a signed-in user is present. Tries are counted together with sign-ins, in a transaction of their own.

    Args:
        code: of the second factor, where the user has one.

    Raises:
        TooMany: too many wrong passwords lately, or too many people at this moment. Forbidden: it or the code is wrong, or the account
            is closed.
    """
    with place(), transaction() as db:
        user = db.get_one(User, user_id)
        set_actor(db, user.email, user_id)
        attempt = _count_attempt(db, user.email, known=True)
        wrong = None
        if not (_hasher.verify(password, user.password_hash) and user.active):
            wrong = "The password is wrong.", "Nothing was changed; try again."
        elif not second_factor.accepts(db, user.id, code):
            wrong = "The code of the second factor is wrong or missing.", "Nothing was changed; give the one of now."
        if wrong is None:
            repository.forget_failures(db, attempt)
        else:
            repository.mark_failed(db, attempt)
            record(db, "refuse", "confirmation", user.email, {"why": wrong[0]})
    if wrong is not None:
        raise Forbidden(*wrong)


def administers(caller: Caller, study_id: int, site_id: int | None = None) -> bool:
    """Decide whether the caller may manage accounts of a site, or (site_id None) of a whole study."""
    where = caller.grants_with(MANAGE_ACCOUNTS)
    return caller.is_system or any(g.study_id == study_id and g.site_id in (None, site_id) for g in where)


def manages(caller: Caller, user: User) -> bool:
    """Decide whether the caller administers everything that the user has access to, and there is something."""
    return bool(user.memberships) and all(administers(caller, m.study_id, m.site_id) for m in user.memberships)


def reads_whole_audit(db: Session, caller: Caller) -> bool:
    """Decide whether the caller may read the audit trail, whose rows belong to no study: a grant over every study, at all of its sites."""
    whole = {g.study_id for g in caller.grants_with(READ_AUDIT) if g.site_id is None}
    return caller.is_system or all(study.id in whole for study in repository.studies(db))


def set_active(db: Session, user: User, active: bool, caller: Caller) -> None:
    """Shut a user out at once, or let the user in again. Raises Invalid for oneself."""
    if user.id == caller.user_id:
        raise Invalid("You cannot close your own account.", "Ask another administrator.")
    user.active = active
    db.flush()


def sign_in(db: Session, email: str, password: str, code: str = "") -> str:
    """Check a password and open a browser session; returns the cookie's token.

    Every try is counted as undecided, and committed, before its password is checked. It is taken back when it was right, and committed as
    failed before a wrong one is reported. So however many come at once, no more than FAILURES_ALLOWED of an address get a verdict within
    FAILURE_WINDOW. The caller commits the session.

    Args:
        code: of the second factor, where the user has one.

    Raises:
        TooMany: too many failures of this address lately. Unauthorized: wrong address, password or code; which of them is not revealed.
    """
    address = normal_address(email)
    user = repository.user_by_email(db, email)
    attempt = _count_attempt(db, user.email if user else address, known=user is not None) if address else None
    # an unknown address costs the same time as a wrong password, so that addresses cannot be guessed by the clock. Another user's hash is
    # used, for an address always the same, because hashes of earlier versions cost more
    stand_in = repository.some_password_hash(db, address or "") or _decoy()
    ok = _hasher.verify(password, user.password_hash if user else stand_in)
    if not (ok and user and user.active and attempt and second_factor.accepts(db, user.id, code)):
        if attempt:
            repository.mark_failed(db, attempt)
        # what was typed as an unknown address may be a password
        record(db, "refuse", "sign_in", user.email if user else "unknown address")
        db.commit()
        raise Unauthorized(
            "The e-mail address or the password is wrong.",
            "If you have set up a second factor, its code is needed too.",
        )
    set_actor(db, user.email, user.id, db.info.get("actor", {}).get("request_id"))
    repository.forget_failures(db, attempt)
    return open_session(db, user)


def open_session(db: Session, user: User, issuer: str | None = None) -> str:
    """Open a browser session of a user who has shown who they are, to us or to an identity provider; returns the cookie's token."""
    token = secrets.token_urlsafe(32)
    db.add(SignIn(token_sha256=_hash(token), user_id=user.id, issuer=issuer))
    return token


def _count_attempt(db: Session, address: str, known: bool) -> SignInAttempt:
    """Count a try of an address as undecided, and commit.

    A lock-out is one row of the trail, however often it is tried until it ends. An attacker must not be able to fill the trail.

    Raises:
        TooMany: it has used up its tries, by those that failed alone or with the undecided ones; this one is not counted.
    """
    repository.lock_address(db, address)
    repository.prune_failures(db, FAILURE_WINDOW)
    failed, undecided = repository.recent_tries(db, address, FAILURE_WINDOW, UNDECIDED_WINDOW)
    locked, refused = failed >= FAILURES_ALLOWED, failed + undecided >= FAILURES_ALLOWED
    attempt = SignInAttempt(email=address, failed=False)
    if refused:
        # what was typed as an unknown address may be a password
        record_once(db, "refuse", "sign_in", address if known else "unknown address", LOCKED_OUT if locked else AT_ONCE, FAILURE_WINDOW)
    else:
        db.add(attempt)
    db.commit()
    if refused:
        wait_s = (FAILURE_WINDOW if locked else UNDECIDED_WINDOW).seconds
        said = "failed sign-ins for {}" if locked else "sign-ins for {} are waiting for an answer"
        raise TooMany(f"Too many {said.format(address)}.", f"Wait {in_words(wait_s)} and try again.", wait_s)
    return attempt


def sign_out(db: Session, token: str) -> None:
    """End a browser session."""
    row = repository.sign_in_of(db, _hash(token))
    if row and row.ended_at is None:
        row.ended_at = now()


def caller_of_cookie(db: Session, token: str, used: bool = True) -> Caller | None:
    """Find the owner of the cookie's token, unless the session idled out or ended; `used` counts as an act against idling."""
    settings = get_settings()
    row = repository.sign_in_by_token(
        db, _hash(token), now() - timedelta(minutes=settings.session_idle_minutes), now() - timedelta(hours=settings.session_max_hours)
    )
    if row is None or not row.user.active:
        return None
    if used:
        _note_use(db, row, "last_seen_at")
    return replace(caller_of(row.user), sign_in_id=row.id, confirmed_at=row.confirmed_at)


def last_user_of_cookie(db: Session, token: str) -> int | None:
    """Find whose browser session a cookie's token was, although it has ended."""
    row = repository.sign_in_of(db, _hash(token)) if token else None
    return row.user_id if row is not None else None


def caller_of_token(db: Session, token: str) -> Caller | None:
    """Find the owner of an API token, unless it was revoked or has run out. The time of its last use is stored, to the minute."""
    row = repository.api_token_by_hash(db, _hash(token))
    if row is None or not row.user.active:
        return None
    _note_use(db, row, "last_used_at")
    return replace(caller_of(row.user), token_scope=Scope(row.scope))


def _note_use(db: Session, row: SignIn | ApiToken, column: str) -> None:
    """Store when a session or token was used, and commit: that is no part of the request, and no other request waits for its row."""
    last = getattr(row, column)
    if last is None or now() - last > _SEEN_RESOLUTION:
        setattr(row, column, now())
        db.commit()


def caller_of(user: User) -> Caller:
    """Convert a user to an acting caller."""
    return Caller(user.email, user.id, tuple(_grant(m) for m in user.memberships))


def _grant(m: Membership) -> Grant:
    return Grant(m.study_id, m.site_id, Role(m.role), ended=m.study.ended_at is not None)


def create_token(db: Session, email: str, name: str, scope: Scope = Scope.FULL, days: int = TOKEN_DAYS) -> str:
    """Make an API token and return it; it is shown this once.

    Args:
        name: what will use it. scope: what it may do of what the user may. days: after which it ends, 1 to MOST_TOKEN_DAYS.

    Raises:
        NotFound: no such user. Invalid: a bad name or number of days. Conflict: the user has a token of this name.
    """
    if not 1 <= days <= MOST_TOKEN_DAYS:
        raise Invalid(f"A token cannot last {days} days.", f"Give 1 to {MOST_TOKEN_DAYS}.", field="days")
    user = repository.user_by_email(db, email)
    if user is None:
        raise NotFound(f"There is no user {email}.", "Make one with `betaloop user add`.")
    name = name.strip()
    if not name or len(name) > 100:
        raise Invalid("A token needs a name of 1-100 characters.", "Name it after what will use it, e.g. 'upload-tablet'.", field="name")
    if repository.token_by_name(db, user.id, name):
        raise Conflict(f"{email} already has a token named '{name}'.", "Choose another name.", field="name")
    token = _TOKEN_PREFIX + secrets.token_urlsafe(32)
    db.add(ApiToken(user_id=user.id, name=name, scope=scope, token_sha256=_hash(token), expires_at=now() + timedelta(days=days)))
    db.flush()
    return token


def revoke_token(db: Session, user_id: int, token_id: int) -> None:
    """End an API token of this user."""
    row = db.get(ApiToken, token_id)
    if row is None or row.user_id != user_id:
        raise NotFound("You have no such token.")
    row.revoked_at = row.revoked_at or now()


def study_of(db: Session, code: str | None) -> Study:
    """Find the study of a code, or the only one. Raises NotFound naming those there are."""
    known = repository.studies(db)
    found = [s for s in known if code in (None, s.code)]
    if len(found) != 1:
        raise NotFound(f"Which study? Known: {', '.join(s.code for s in known)}.", "Name one.")
    return found[0]


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
