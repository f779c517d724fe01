"""Rules of a sign-on: which account belongs to a provider's subject, and what a sign-on confirms. The caller commits."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session, selectinload

from app.accounts import repository as accounts
from app.accounts.permissions import CONFIRMED_FOR, Caller
from app.accounts.service import confirm_password, open_session
from app.accounts.sign_on_provider import Identity, Refused
from app.platform.audit import record
from app.platform.audit.signatures import Signer
from app.platform.audit.signatures import record as record_signature
from app.platform.database import now, set_actor
from app.platform.errors import Forbidden, about
from app.tables.accounts import SignIn, SignOnLink, User
from app.tables.audit import Signature

# Every query of a sign-on.


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


_AGAIN = "Begin again, and give your password there; or give the one of here."


def sign_on(db: Session, identity: Identity) -> str:
    """Open a browser session of the account that belongs to an identity; returns the cookie's token. Refusals are committed to the trail.

    An account belongs to whom it was linked with at their first sign-on, by an address that the provider vouches for; none is made here.

    Raises:
        Refused: there is none, it is closed, or it belongs to another subject at the provider.
    """
    link = link_of(db, identity.issuer, identity.subject)
    user = link.user if link else _user_of(db, identity.address)
    if user is None:
        raise _refused(db, "unknown account", "There is no account here of an address that the sign-on vouches for.")
    if not user.active:
        raise _refused(db, user.email, "Your account here is closed.")
    if link is None:
        # two first sign-ons of one person at once: the second one waits here, and finds the link of the first
        db.refresh(user, with_for_update=True)
        link = link_of(db, identity.issuer, identity.subject)
    if link is None and link_of_user(db, user.id, identity.issuer):
        raise _refused(db, user.email, "The account of your address belongs to another person at the sign-on.")
    set_actor(db, user.email, user.id, db.info.get("actor", {}).get("request_id"))
    if link is None:
        link = SignOnLink(user_id=user.id, issuer=identity.issuer, subject=identity.subject)
        db.add(link)
        db.flush()
    use_login(db, link, identity.asked_at)
    return open_session(db, user, identity.issuer)


def confirm(db: Session, caller: Caller, identity: Identity) -> None:
    """Note that the user of a browser session has shown, just now, who they are: this replaces the password of one signature.

    Raises:
        Refused: it was another user, or a login that was shown here before, for a sign-on or another signature.
    """
    link = link_of(db, identity.issuer, identity.subject)
    row = db.get(SignIn, caller.sign_in_id) if caller.sign_in_id is not None else None
    if link is None:
        raise _refused(
            db, caller.label, "This sign-on is linked with no account yet: sign out and sign on with it once, or give your password."
        )
    if row is None or link.user_id != caller.user_id:
        raise _refused(db, caller.label, "Another person has signed on at the provider than the user of this page.")
    if not use_login(db, link, identity.asked_at):
        raise _refused(db, caller.label, "The provider has not asked you again who you are since you last signed on or confirmed.", _AGAIN)
    row.confirmed_at = now()


def use_confirmation(db: Session, caller: Caller) -> None:
    """Use up the confirmation of the caller's browser session. Raises Forbidden where there is none, or an old one."""
    since = now() - CONFIRMED_FOR
    if caller.sign_in_id is None or caller.user_id is None or not take_confirmation(db, caller.sign_in_id, caller.user_id, since):
        raise Forbidden(
            "You have not confirmed who you are.",
            f"Give your password, or confirm with the sign-on and sign within {CONFIRMED_FOR.seconds // 60} minutes.",
        )


def _user_of(db: Session, address: str | None) -> User | None:
    """Find the user of exactly this address. What only looks alike (NFKC, ß and ss) may be another mailbox, which the provider vouches
    for."""
    user = accounts.user_by_email(db, address) if address else None
    return user if user is not None and address is not None and user.email == address.strip().lower() else None


def _refused(db: Session, whose: str, detail: str, hint: str = "Ask an administrator of the study.") -> Refused:
    db.rollback()
    record(db, "refuse", "sign_on", whose)
    db.commit()
    return Refused(detail, hint)


# Signing: the signer shows again who they are, and the signed content is stored (`app.platform.audit.signatures`).
#
# They give the password again (with the code of a second factor), or the hospital's sign-on asked them again. That was at most five
# minutes ago, in this browser session, for this one signature.


def sign(
    db: Session, caller: Caller, password: str, *, kind: str, subject_id: int, meaning: str, content: Mapping[str, Any], code: str = ""
) -> Signature:
    """Sign something with one's password or, where it is empty, a fresh sign-on. The transaction is not committed.

    The function that calls this must check whether the caller may sign it at all.

    Args:
        kind: what is signed, e.g. `plan`. subject_id: which. meaning: what the signature says, e.g. "approved for use in this participant".
        content: all that is signed; kept with its hash. code: of the second factor, where the signer has one.

    Raises:
        Forbidden: the system, which is no person, a wrong password or code, or a confirmation that is too old. TooMany: too many wrong
            passwords lately.
    """
    if caller.user_id is None:
        raise Forbidden("Only a person can sign.", "Sign in as the person who signs.")
    if password or caller.confirmed_at is None:
        with about("password"):
            confirm_password(caller.user_id, password, code)
    else:
        use_confirmation(db, caller)
    return record_signature(db, Signer(caller.user_id, caller.label), kind=kind, subject_id=subject_id, meaning=meaning, content=content)
