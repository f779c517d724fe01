"""The page of studies: their sites, who works there in which role, and the forms that change it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import ValidationError
from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts import permissions as can
from app.accounts import repository as accounts
from app.accounts import studies as studies_rules
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.accounts.service import administers, manages
from app.accounts.studies import (
    HINT,
    Member,
    MemberIn,
    MemberOut,
    NameChange,
    SiteIn,
    SiteOut,
    StudyChange,
    StudyIn,
    StudyOut,
    site_out,
    study_out,
)
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import FormValues, field_notes
from app.platform.web.schemas import problems
from app.platform.web.templates import render
from app.tables.accounts import Role, Study

# FastAPI dependency: the study that a path names, of which the caller is an administrator.


def managed_study(study_code: Annotated[str, Path(max_length=40, pattern=r"^[^\x00]*$")], db: Db, caller: CurrentCaller) -> Study:
    """Find the study. Raises NotFound, Forbidden."""
    return studies_rules.study_to_manage(db, study_code, caller)


ManagedStudy = Annotated[Study, Depends(managed_study)]


# REST routes of studies, sites and memberships. Roles are given and ended by people who have signed in, and by no token.

api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@api.get("/studies")
def list_studies(db: Db, caller: CurrentCaller) -> list[StudyOut]:
    """List the studies that the caller may read, with their sites."""
    return [study_out(db, s) for s in accounts.studies(db) if caller.may(can.READ, s.id)]


@api.post("/studies", status_code=201, responses=problems(409))
def add_study(draft: StudyIn, db: Db, caller: CurrentCaller) -> StudyOut:
    """Add a study with its first site. Needs an administrator of all studies."""
    study = studies_rules.add_study(db, draft, caller)
    return study_out(db, study)


@api.patch("/studies/{study_code}", responses=problems(409))
def change_study(study: ManagedStudy, change: StudyChange, db: Db, caller: CurrentCaller) -> StudyOut:
    """Give a study another name, or one without a prefix of participants' codes a prefix."""
    studies_rules.change_study(db, study, change, caller)
    return study_out(db, study)


@api.post("/studies/{study_code}/sites", status_code=201, responses=problems(409))
def add_site(study: ManagedStudy, draft: SiteIn, db: Db) -> SiteOut:
    """Add a site to a study."""
    site = studies_rules.add_site(db, study, draft)
    return site_out(site)


@api.patch("/studies/{study_code}/sites/{site_code}")
def rename_site(study: ManagedStudy, site_code: str, change: NameChange, db: Db) -> SiteOut:
    """Give a site another name."""
    site = studies_rules.rename_site(db, study, site_code, change.name, change.reason)
    return site_out(site)


@api.get("/studies/{study_code}/members")
def list_members(study: ManagedStudy, db: Db) -> list[MemberOut]:
    """List the members of a study and their roles, by address."""
    members = studies_rules.members_of(db, study.id)
    return [MemberOut(email=u.email, role=Role(m.role), site=site, active=u.active) for u, m, site in members]


@api.put("/studies/{study_code}/members")
def give_role(study: ManagedStudy, member: MemberIn, db: Db, caller: CurrentCaller) -> MemberOut:
    """Give a user a role at one site or at all. It replaces the role there; at one site also a role at all sites, unless `also` is set.

    Needs a browser session.
    """
    caller.require_browser()
    given = studies_rules.grant(db, study, member.email, member.role, member.site, caller, also=member.also)
    return MemberOut(email=given.user.email, role=Role(given.role), site=member.site, active=given.user.active)


@api.post("/studies/{study_code}/members/end", status_code=204)
def end_role(study: ManagedStudy, member: Member, db: Db, caller: CurrentCaller) -> None:
    """End a user's role, at once for whatever the user has open. Needs a browser session."""
    caller.require_browser()
    studies_rules.end_membership(db, study, member.email, member.site, caller)


pages = APIRouter()


@pages.get("/studies")
def studies(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the studies that the caller administers."""
    caller.require(can.MANAGE_ACCOUNTS)
    return _page(request, db, caller)


@pages.post("/studies")
def add_study_by_form(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Add a study with its first site."""

    def change() -> None:
        studies_rules.add_study(db, StudyIn(**_code_and_name(values), code_prefix=_text(values, "code_prefix")), caller)

    return changed(request, db, caller, "study", change)


@pages.post("/studies/{study_code}")
def change_study_by_form(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Give a study another name, or one without a prefix of codes a prefix."""

    def change() -> None:
        wanted = StudyChange(name=_text(values, "name"), code_prefix=_text(values, "code_prefix"), reason=reason_of(values))
        studies_rules.change_study(db, studies_rules.study_to_manage(db, study_code, caller), wanted, caller)

    return changed(request, db, caller, "changed", change)


@pages.post("/studies/{study_code}/sites")
def add_site_by_form(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Add a site to a study."""

    def change() -> None:
        studies_rules.add_site(db, studies_rules.study_to_manage(db, study_code, caller), SiteIn(**_code_and_name(values)))

    return changed(request, db, caller, "site", change)


@pages.post("/studies/{study_code}/sites/{site_code}")
def rename_site_by_form(request: Request, study_code: str, site_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Give a site another name."""

    def change() -> None:
        wanted = NameChange(name=_text(values, "name") or "", reason=reason_of(values))
        studies_rules.rename_site(db, studies_rules.study_to_manage(db, study_code, caller), site_code, wanted.name, wanted.reason)

    return changed(request, db, caller, "changed", change)


@pages.post("/studies/{study_code}/members")
def grant(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Give a user a role."""

    def change() -> None:
        role = str(values.get("role", ""))
        if role not in set(Role):
            raise Invalid("Choose a role.", f"Known: {', '.join(Role)}.", field="role")
        study = studies_rules.study_to_manage(db, study_code, caller)
        studies_rules.grant(
            db, study, str(values.get("email", "")), Role(role), str(values.get("site", "")) or None, caller, also="also" in values
        )

    return changed(request, db, caller, "member", change)


@pages.post("/studies/{study_code}/members/end")
def end_membership(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """End a user's role."""

    def change() -> None:
        study = studies_rules.study_to_manage(db, study_code, caller)
        studies_rules.end_membership(db, study, str(values.get("email", "")), str(values.get("site", "")) or None, caller)

    return changed(request, db, caller, "ended", change)


def changed(request: Request, db: Session, caller: Caller, done: str, change: Callable[[], object]) -> Response:
    """Do a change and show the page with what was done, or with what is wrong. Raises Forbidden for a token."""
    caller.require_browser()
    try:
        caller.require(can.MANAGE_ACCOUNTS)
        change()
    except ValidationError as error:
        db.rollback()
        field = error.errors()[0]
        what = Invalid(f"The {field['loc'][0]}: {field['msg']}.", HINT, field=str(field["loc"][0]))
        return _page(request, db, caller, what)
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, caller, error)
    return RedirectResponse(f"/studies?done={done}", 303)


def reason_of(values: FormData) -> str:
    """Read why something changes. Raises Invalid where no reason is given."""
    reason = str(values.get("reason", "")).strip()
    if not 1 <= len(reason) <= 1000:
        raise Invalid(
            "There is no reason, or it has more than 1000 characters.", "Say why this changes; the audit trail keeps it.", field="reason"
        )
    return reason


def _text(values: FormData, name: str) -> str | None:
    return str(values.get(name, "")).strip() or None


def _code_and_name(values: FormData) -> dict[str, Any]:
    return {name: str(values.get(name, "")).strip() for name in ("code", "name")}


def _page(request: Request, db: Session, caller: Caller, error: BetaloopError | None = None) -> HTMLResponse:
    mine = [s for s in accounts.studies(db) if administers(caller, s.id)]
    users = accounts.users(db)
    shown = []
    for study in mine:
        sites = {site.id: site for site in studies_rules.sites_of(db, study.id)}
        members = [(u, m, sites.get(m.site_id) if m.site_id else None) for u in users for m in u.memberships if m.study_id == study.id]
        shown.append((study, list(sites.values()), members))
    page = render(
        request,
        "accounts/studies.html",
        shown=shown,
        users=[u for u in users if u.active and manages(caller, u)],
        roles=list(Role),
        refused=request.url.path,
        remarks=field_notes(error, {}),
        may_add=len(mine) == len(accounts.studies(db)),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
