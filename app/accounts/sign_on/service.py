"""Rules of a sign-on: which account belongs to a provider's subject, and what a sign-on confirms. The caller commits."""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.accounts import repository as accounts
from app.accounts.permissions import CONFIRMED_FOR, Caller
from app.accounts.service import open_session
from app.accounts.sign_on import repository
from app.accounts.sign_on.provider import Identity, Refused
from app.platform.audit import record
from app.platform.database import now, set_actor
from app.platform.errors import Forbidden
from app.tables.accounts import SignIn, SignOnLink, User

_AGAIN = "Begin again, and give your password there; or give the one of here."


def sign_on(db: Session, identity: Identity) -> str:
    """Open a browser session of the account that belongs to an identity; returns the cookie's token. Refusals are committed to the trail.

    An account belongs to whom it was linked with at their first sign-on, by an address that the provider vouches for; none is made here.

    Raises:
        Refused: there is none, it is closed, or it belongs to another subject at the provider.
    """
    link = repository.link_of(db, identity.issuer, identity.subject)
    user = link.user if link else _user_of(db, identity.address)
    if user is None:
        raise _refused(db, "unknown account", "There is no account here of an address that the sign-on vouches for.")
    if not user.active:
        raise _refused(db, user.email, "Your account here is closed.")
    set_actor(db, user.email, user.id, db.info.get("actor", {}).get("request_id"))
    if link is None:
        # two first sign-ons of one person at once: the second one waits here, and finds the link of the first
        db.refresh(user, with_for_update=True)
        link = repository.link_of(db, identity.issuer, identity.subject)
    if link is None:
        if repository.link_of_user(db, user.id, identity.issuer):
            raise _refused(db, user.email, "The account of your address belongs to somebody else at the sign-on.")
        link = SignOnLink(user_id=user.id, issuer=identity.issuer, subject=identity.subject)
        db.add(link)
        db.flush()
    repository.use_login(db, link, identity.asked_at)
    return open_session(db, user, identity.issuer)


def confirm(db: Session, caller: Caller, identity: Identity) -> None:
    """Note that the user of a browser session has shown, just now, who they are: this replaces the password of one signature.

    Raises:
        Refused: it was another user, or a login that was shown here before, for a sign-on or another signature.
    """
    link = repository.link_of(db, identity.issuer, identity.subject)
    row = db.get(SignIn, caller.sign_in_id) if caller.sign_in_id is not None else None
    if link is None:
        raise _refused(
            db, caller.label, "This sign-on is linked with no account yet: sign out and sign on with it once, or give your password."
        )
    if row is None or link.user_id != caller.user_id:
        raise _refused(db, caller.label, "Somebody else has signed on at the provider than the user of this page.")
    if not repository.use_login(db, link, identity.asked_at):
        raise _refused(db, caller.label, "The provider has not asked you again who you are since you last signed on or confirmed.", _AGAIN)
    row.confirmed_at = now()


def use_confirmation(db: Session, caller: Caller) -> None:
    """Use up the confirmation of the caller's browser session. Raises Forbidden where there is none, or an old one."""
    since = now() - CONFIRMED_FOR
    if (
        caller.sign_in_id is None
        or caller.user_id is None
        or not repository.take_confirmation(db, caller.sign_in_id, caller.user_id, since)
    ):
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
