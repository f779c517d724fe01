"""REST routes of studies, sites and memberships. Roles are given and ended by people who have signed in, and by no token."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts import permissions as can
from app.accounts import repository as accounts
from app.accounts.deps import CurrentCaller
from app.accounts.studies import repository, service
from app.accounts.studies.deps import ManagedStudy
from app.accounts.studies.schemas import Member, MemberIn, MemberOut, NameChange, SiteIn, SiteOut, StudyChange, StudyIn, StudyOut
from app.accounts.studies.serializers import site_out, study_out
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.tables.accounts import Role

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@router.get("/studies")
def list_studies(db: Db, caller: CurrentCaller) -> list[StudyOut]:
    """List the studies that the caller may read, with their sites."""
    return [study_out(db, s) for s in accounts.studies(db) if caller.may(can.READ, s.id)]


@router.post("/studies", status_code=201, responses=problems(409))
def add_study(draft: StudyIn, db: Db, caller: CurrentCaller) -> StudyOut:
    """Add a study with its first site. Needs an administrator of all studies."""
    study = service.add_study(db, draft, caller)
    return study_out(db, study)


@router.patch("/studies/{study_code}", responses=problems(409))
def change_study(study: ManagedStudy, change: StudyChange, db: Db, caller: CurrentCaller) -> StudyOut:
    """Give a study another name, or one without a prefix of participants' codes a prefix."""
    service.change_study(db, study, change, caller)
    return study_out(db, study)


@router.post("/studies/{study_code}/sites", status_code=201, responses=problems(409))
def add_site(study: ManagedStudy, draft: SiteIn, db: Db) -> SiteOut:
    """Add a site to a study."""
    site = service.add_site(db, study, draft)
    return site_out(site)


@router.patch("/studies/{study_code}/sites/{site_code}")
def rename_site(study: ManagedStudy, site_code: str, change: NameChange, db: Db) -> SiteOut:
    """Give a site another name."""
    site = service.rename_site(db, study, site_code, change.name, change.reason)
    return site_out(site)


@router.get("/studies/{study_code}/members")
def list_members(study: ManagedStudy, db: Db) -> list[MemberOut]:
    """List the members of a study and their roles, by address."""
    return [MemberOut(email=u.email, role=Role(m.role), site=site, active=u.active) for u, m, site in repository.members_of(db, study.id)]


@router.put("/studies/{study_code}/members")
def give_role(study: ManagedStudy, member: MemberIn, db: Db, caller: CurrentCaller) -> MemberOut:
    """Give a user a role at one site or at all. It replaces the role there; at one site also a role at all sites, unless `also` is set.

    Needs a browser session.
    """
    caller.require_browser()
    given = service.grant(db, study, member.email, member.role, member.site, caller, also=member.also)
    return MemberOut(email=given.user.email, role=Role(given.role), site=member.site, active=given.user.active)


@router.post("/studies/{study_code}/members/end", status_code=204)
def end_role(study: ManagedStudy, member: Member, db: Db, caller: CurrentCaller) -> None:
    """End a user's role, at once for whatever the user has open. Needs a browser session."""
    caller.require_browser()
    service.end_membership(db, study, member.email, member.site, caller)
