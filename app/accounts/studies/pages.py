"""The page of studies: their sites, who works there in which role, and the forms that change it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import ValidationError
from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts import permissions as can
from app.accounts import repository as accounts
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.accounts.service import administers, manages
from app.accounts.studies import repository, service
from app.accounts.studies.schemas import HINT, NameChange, SiteIn, StudyChange, StudyIn
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import FormValues, field_notes
from app.platform.web.templates import render
from app.tables.accounts import Role

router = APIRouter()


@router.get("/studies")
def studies(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the studies that the caller administers."""
    caller.require(can.MANAGE_ACCOUNTS)
    return _page(request, db, caller)


@router.post("/studies")
def add_study(request: Request, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Add a study with its first site."""

    def change() -> None:
        service.add_study(db, StudyIn(**_code_and_name(values), code_prefix=_text(values, "code_prefix")), caller)

    return changed(request, db, caller, "study", change)


@router.post("/studies/{study_code}")
def change_study(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Give a study another name, or one without a prefix of codes a prefix."""

    def change() -> None:
        wanted = StudyChange(name=_text(values, "name"), code_prefix=_text(values, "code_prefix"), reason=reason_of(values))
        service.change_study(db, service.study_to_manage(db, study_code, caller), wanted, caller)

    return changed(request, db, caller, "changed", change)


@router.post("/studies/{study_code}/sites")
def add_site(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Add a site to a study."""

    def change() -> None:
        service.add_site(db, service.study_to_manage(db, study_code, caller), SiteIn(**_code_and_name(values)))

    return changed(request, db, caller, "site", change)


@router.post("/studies/{study_code}/sites/{site_code}")
def rename_site(request: Request, study_code: str, site_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Give a site another name."""

    def change() -> None:
        wanted = NameChange(name=_text(values, "name") or "", reason=reason_of(values))
        service.rename_site(db, service.study_to_manage(db, study_code, caller), site_code, wanted.name, wanted.reason)

    return changed(request, db, caller, "changed", change)


@router.post("/studies/{study_code}/members")
def grant(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Give a user a role."""

    def change() -> None:
        role = str(values.get("role", ""))
        if role not in set(Role):
            raise Invalid("Choose a role.", f"Known: {', '.join(Role)}.", field="role")
        study = service.study_to_manage(db, study_code, caller)
        service.grant(
            db, study, str(values.get("email", "")), Role(role), str(values.get("site", "")) or None, caller, also="also" in values
        )

    return changed(request, db, caller, "member", change)


@router.post("/studies/{study_code}/members/end")
def end_membership(request: Request, study_code: str, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """End a user's role."""

    def change() -> None:
        study = service.study_to_manage(db, study_code, caller)
        service.end_membership(db, study, str(values.get("email", "")), str(values.get("site", "")) or None, caller)

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
        sites = {site.id: site for site in repository.sites_of(db, study.id)}
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
