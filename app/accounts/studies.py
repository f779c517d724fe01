"""Studies, their sites, and who works in them in which role."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from typing import Annotated

from pydantic import Field, StringConstraints
from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from app.accounts import repository as accounts
from app.accounts.permissions import READ, Caller
from app.accounts.service import administers
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Forbidden, Invalid, NotFound
from app.platform.web.schemas import Model, Text
from app.tables.accounts import Membership, Role, Site, Study, User
from app.tables.participants import Participant

# API types of studies, sites and memberships.

HINT = (
    "A code has 1 to 40 letters, digits, dots or hyphens; a name 1 to 200 characters; "
    "a prefix 1 to 20 letters, digits, hyphens or underscores, the first a letter or digit."
)
ShortCode = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,39}$")]
Name = Annotated[Text, StringConstraints(strip_whitespace=True, min_length=1, max_length=200)]
Prefix = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,19}$")]
Reason = Annotated[Text, StringConstraints(strip_whitespace=True, min_length=1, max_length=1000)]


class SiteIn(Model):
    """A site to add."""

    code: ShortCode
    name: Name


class StudyIn(SiteIn):
    """A study to add; its first site has the same code and name unless one is given."""

    site: SiteIn | None = None
    code_prefix: Prefix | None = Field(
        None, description="What every code of its participants begins with; the study's code and a hyphen by default."
    )


class StudyChange(Model):
    """Another name, or the prefix that a study lacks, and why."""

    name: Name | None = None
    code_prefix: Prefix | None = Field(None, description="Of a study that has none: what codes begin with from now on.")
    reason: Reason = Field(description="Why; kept in the audit trail.")


class NameChange(Model):
    """Another name, and why."""

    name: Name
    reason: Text = Field(min_length=1, max_length=1000, description="Why; kept in the audit trail.")


class EndingReason(Model):
    """Reason why a study or a site ends, or is opened again."""

    reason: Reason = Field(description="Kept in the audit trail.")


class SiteOut(Model):
    """A site. One that has ended takes neither enrolments nor uploads."""

    code: str
    name: str
    ended_at: datetime | None


class StudyOut(Model):
    """A study and its sites. One that has ended is read, and nothing in it changes."""

    code: str
    name: str
    code_prefix: str | None = Field(description="What every code of its participants begins with; null for the first study.")
    ended_at: datetime | None
    sites: list[SiteOut]


class Member(Model):
    """Member of a study: a user with a role, at a site or at all sites."""

    email: Text = Field(max_length=254, description="E-mail address of the user.")
    site: ShortCode | None = Field(None, description="Code of the site; null is all sites.")


class MemberIn(Member):
    """A role to give. It replaces the role that the user has there, and a role at one site also one at all sites."""

    role: Role
    also: bool = Field(False, description="Keep a role at all sites besides this one at a single site.")


class MemberOut(Model):
    """A user's role in a study."""

    email: str
    role: Role
    site: str | None = Field(description="Code of the site; null is all sites.")
    active: bool = Field(description="Whether the account is open.")


# Every query of studies, sites and memberships.


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


# Prefixes of participants' codes of a study: a user who enrols in one study never learns which codes another has.
#
# Codes are unique in an installation, because addresses name participants by them. Every study but the first has a prefix of its own,
# none the beginning of another's. A code is compared with these before it is looked up, so that "taken" refers to the own study alone.

LONGEST = 20


def default_of(code: str) -> str:
    """Choose the prefix of a study for which none is stated. Raises Invalid for a code that is too long."""
    prefix = code.replace(".", "-") + "-"
    if len(prefix) > LONGEST:
        raise Invalid(f"'{prefix}' is too long to begin participants' codes with.", f"State a prefix of at most {LONGEST} characters.")
    return prefix


def claim(db: Session, study: Study, prefix: Prefix) -> None:
    """Give a study without a prefix one. Until then no participant is enrolled.

    Raises:
        Conflict: it has one, one of another study begins with this or the other way round, or codes of another study begin with it.
    """
    if study.code_prefix is not None:
        raise Conflict(f"Codes of study '{study.code}' begin with '{study.code_prefix}', and participants are known by them.", "Keep it.")
    lock_codes(db, exclusively=True)
    lower = prefix.lower()
    for _, code, theirs in prefixes(db):
        if lower.startswith(theirs.lower()) or theirs.lower().startswith(lower):
            raise Conflict(f"'{prefix}' and the prefix '{theirs}' of study '{code}' cannot be distinguished.", "Choose another.")
    if codes_elsewhere(db, study.id, prefix):
        raise Conflict(f"Codes of another study's participants begin with '{prefix}'.", "Choose another prefix.")
    study.code_prefix = prefix
    db.flush()


def require_own(db: Session, study: Study, code: str) -> str:
    """Return what follows the study's prefix in the code of a participant to enrol; until the transaction ends no study claims a prefix.

    Raises:
        Invalid: the code has not this study's prefix, or has another one's. No participant is looked up for it.
    """
    lock_codes(db, exclusively=False)
    known = {number: prefix for number, _, prefix in prefixes(db)}
    prefix = known.pop(study.id, "")
    if prefix and not (code.lower().startswith(prefix.lower()) and len(code) > len(prefix)):
        raise Invalid(f"Participants' codes of study '{study.code}' begin with '{prefix}'.", f"Choose one such as {prefix}1.")
    if any(code.lower().startswith(theirs.lower()) for theirs in known.values()):
        raise Invalid(f"'{code}' begins as codes of another study do.", "Choose a code that begins otherwise.")
    return code[len(prefix) :]


# Rules of studies, sites and memberships. The caller commits.


def add_study(db: Session, draft: StudyIn, caller: Caller) -> Study:
    """Add a study with its first site; who adds it administers it.

    Raises:
        Forbidden: the caller does not administer every study that there is. Conflict: the code is taken, or the prefix cannot be used.
        Invalid: the code is too long to make a prefix of, and none is stated.
    """
    others = accounts.studies(db)
    _require_all(others, caller)
    if study_by_code(db, draft.code):
        raise Conflict(f"There is already a study '{draft.code}'.", "Choose another code.", field="code")
    study = Study(code=draft.code, name=draft.name)
    db.add(study)
    db.flush()
    if draft.code_prefix is not None or others:
        claim(db, study, draft.code_prefix or default_of(draft.code))
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
    study = study_by_code(db, code)
    if study is None or not caller.may(READ, study.id):
        raise NotFound(f"There is no study '{code}', or you have no access to it.")
    if not administers(caller, study.id):
        raise Forbidden(f"You do not administer study '{code}' at all of its sites.", "Ask a person who does.")
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
        claim(db, study, change.code_prefix)
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
    wider = None if also or site_id is None else membership(db, user.id, study.id, None)
    others = [m.role for m in user.memberships if m.study_id == study.id and m.site_id != site_id]
    if others and Role.BLINDED_ASSESSOR in (role, *others) and {role, *others} != {Role.BLINDED_ASSESSOR}:
        raise Invalid("A blinded assessor has no other role in the study.", "End the other role first.")
    elsewhere = [m for m in user.memberships if m.study_id != study.id and m.role != Role.BLINDED_ASSESSOR]
    if role is Role.BLINDED_ASSESSOR and not all(administers(caller, m.study_id, m.site_id) for m in elsewhere):
        raise Forbidden(
            f"{user.email} works in a study that you do not administer, and a blinded assessor is blinded in every study.",
            "Ask an administrator of both studies, or name another person.",
        )
    found = membership(db, user.id, study.id, site_id)
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
    found = membership(db, user.id, study.id, site_id)
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


# Rows of studies and sites as API types.


def study_out(db: Session, study: Study) -> StudyOut:
    """Convert a study with its sites."""
    sites = [site_out(s) for s in sites_of(db, study.id)]
    return StudyOut(code=study.code, name=study.name, code_prefix=study.code_prefix, ended_at=study.ended_at, sites=sites)


def site_out(site: Site) -> SiteOut:
    """Convert a site."""
    return SiteOut(code=site.code, name=site.name, ended_at=site.ended_at)
