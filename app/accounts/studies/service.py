"""Rules of studies, sites and memberships. The caller commits."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy.orm import Session

from app.accounts import repository as accounts
from app.accounts.permissions import READ, Caller
from app.accounts.service import administers
from app.accounts.studies import prefixes, repository
from app.accounts.studies.schemas import SiteIn, StudyChange, StudyIn
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Forbidden, Invalid, NotFound
from app.tables.accounts import Membership, Role, Site, Study, User


def add_study(db: Session, draft: StudyIn, caller: Caller) -> Study:
    """Add a study with its first site; who adds it administers it.

    Raises:
        Forbidden: the caller does not administer every study that there is. Conflict: the code is taken, or the prefix cannot be used.
        Invalid: the code is too long to make a prefix of, and none is stated.
    """
    others = accounts.studies(db)
    _require_all(others, caller)
    if repository.study_by_code(db, draft.code):
        raise Conflict(f"There is already a study '{draft.code}'.", "Choose another code.", field="code")
    study = Study(code=draft.code, name=draft.name)
    db.add(study)
    db.flush()
    if draft.code_prefix is not None or others:
        prefixes.claim(db, study, draft.code_prefix or prefixes.default_of(draft.code))
    first = draft.site or SiteIn(code=draft.code, name=draft.name)
    db.add(Site(study_id=study.id, code=first.code, name=first.name))
    if caller.user_id is not None:
        db.add(Membership(user_id=caller.user_id, study_id=study.id, role=Role.ADMIN))
    db.flush()
    return study


def study_to_manage(db: Session, code: str, caller: Caller) -> Study:
    """Find a study that the caller administers at all of its sites.

    Raises:
        NotFound: a study that the caller may not read. Forbidden: one that the caller reads and does not administer.
    """
    study = repository.study_by_code(db, code)
    if study is None or not caller.may(READ, study.id):
        raise NotFound(f"There is no study '{code}', or you have no access to it.")
    if not administers(caller, study.id):
        raise Forbidden(f"You do not administer study '{code}' at all of its sites.", "Ask somebody who does.")
    return study


def change_study(db: Session, study: Study, change: StudyChange, caller: Caller) -> None:
    """Give a study another name, or the prefix that it lacks; its code stays, and so do codes of participants.

    Raises:
        Invalid: neither. Conflict: a prefix that cannot be used. Forbidden: one by a user who does not administer all studies, since
            another study's codes may prevent it.
    """
    if change.name is None and change.code_prefix is None:
        raise Invalid("Nothing is to change.", "Give a name or a prefix.", field="name")
    set_reason(db, change.reason)
    if change.code_prefix is not None:
        _require_all(accounts.studies(db), caller)
        prefixes.claim(db, study, change.code_prefix)
    study.name = change.name or study.name
    db.flush()


def set_ended(db: Session, row: Study | Site, ended: bool, reason: str) -> None:
    """End a study or a site, or open it again. Raises Conflict where it is so already."""
    db.refresh(row, with_for_update={"of": type(row)})
    what = f"{'Study' if isinstance(row, Study) else 'Site'} '{row.code}'"
    if (row.ended_at is not None) is ended:
        raise Conflict(f"{what} {'has ended already' if ended else 'has not ended'}.", "Load the page again.")
    set_reason(db, reason)
    row.ended_at = now() if ended else None
    db.flush()


def add_site(db: Session, study: Study, draft: SiteIn) -> Site:
    """Add a site. Raises Conflict where its code is taken."""
    if accounts.site_by_code(db, study.id, draft.code):
        raise Conflict(f"Study '{study.code}' has a site '{draft.code}' already.", "Choose another code.", field="code")
    site = Site(study_id=study.id, code=draft.code, name=draft.name)
    db.add(site)
    db.flush()
    return site


def rename_site(db: Session, study: Study, code: str, name: str, reason: str) -> Site:
    """Give a site another name. Raises NotFound."""
    site = site_of(db, study, code)
    set_reason(db, reason)
    site.name = name
    db.flush()
    return site


def site_of(db: Session, study: Study, code: str) -> Site:
    """Find a study's site. Raises NotFound."""
    site = accounts.site_by_code(db, study.id, code)
    if site is None:
        raise NotFound(f"Study '{study.code}' has no site '{code}'.")
    return site


def grant(db: Session, study: Study, email: str, role: Role, site_code: str | None, caller: Caller, *, also: bool = False) -> Membership:
    """Give a user a role in a study, at one site or at all. It replaces the role that the user has there.

    Args:
        also: keep a role at all sites besides one at a single site. Without it the wider role ends: it would apply at every site.

    Raises:
        NotFound: no such user or site. Invalid: one's own role, or a blinded assessor with another role in the study. Forbidden: to blind a
            user who works in a study that the caller does not administer, for it would close that study to them.
    """
    user, site_id = user_of(db, email), site_of(db, study, site_code).id if site_code else None
    _require_other(user, caller)
    wider = None if also or site_id is None else repository.membership(db, user.id, study.id, None)
    others = [m.role for m in user.memberships if m.study_id == study.id and m.site_id != site_id]
    if others and Role.BLINDED_ASSESSOR in (role, *others) and {role, *others} != {Role.BLINDED_ASSESSOR}:
        raise Invalid("A blinded assessor has no other role in the study.", "End the other role first.")
    elsewhere = [m for m in user.memberships if m.study_id != study.id and m.role != Role.BLINDED_ASSESSOR]
    if role is Role.BLINDED_ASSESSOR and not all(administers(caller, m.study_id, m.site_id) for m in elsewhere):
        raise Forbidden(
            f"{user.email} works in a study that you do not administer, and a blinded assessor is blinded in every study.",
            "Ask an administrator of both studies, or name somebody else.",
        )
    found = repository.membership(db, user.id, study.id, site_id)
    if found is None:
        found = Membership(user_id=user.id, study_id=study.id, site_id=site_id, role=role)
        db.add(found)
    found.role = role
    if wider is not None:
        db.delete(wider)
    db.flush()
    db.expire(user, ["memberships"])
    return found


def end_membership(db: Session, study: Study, email: str, site_code: str | None, caller: Caller) -> None:
    """End a user's role in a study; at once, for whatever the user has open.

    Raises:
        NotFound: the user has no role there. Invalid: one's own.
    """
    user, site_id = user_of(db, email), site_of(db, study, site_code).id if site_code else None
    _require_other(user, caller)
    found = repository.membership(db, user.id, study.id, site_id)
    if found is None:
        where = f"at site '{site_code}'" if site_code else "at all sites"
        raise NotFound(f"{user.email} has no role {where} of study '{study.code}'.")
    db.delete(found)
    db.flush()


def _require_all(studies: Iterable[Study], caller: Caller) -> None:
    if not all(administers(caller, study.id) for study in studies):
        raise Forbidden("Studies and their prefixes are added by an administrator of all studies.", "Ask one.")


def user_of(db: Session, email: str) -> User:
    """Find the user of an address. Raises NotFound."""
    user = accounts.user_by_email(db, email)
    if user is None:
        raise NotFound(f"There is no user {email.strip()[:254]}.", "Add the user first.", field="email")
    return user


def _require_other(user: User, caller: Caller) -> None:
    if user.id == caller.user_id:
        raise Invalid("You cannot change your own role.", "Ask another administrator.")
