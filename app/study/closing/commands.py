"""Commands `betaloop study end` and `betaloop study reopen`."""

from __future__ import annotations

from typing import Annotated

import typer

from app.accounts import studies
from app.accounts.permissions import SYSTEM
from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, Why, show
from app.study.closing import service

StudyCode = Annotated[str, typer.Argument(help="Code of the study.")]
SiteCode = Annotated[str | None, typer.Option("--site", help="Code of a site; the whole study when left out.")]


def end(code: StudyCode, reason: Why, site: SiteCode = None, as_json: AsJson = False) -> None:
    """End a study, in which nothing changes then, or one of its sites, which then takes neither enrolments nor uploads."""
    with transaction(ACTOR) as db:
        study = studies.study_to_manage(db, code, SYSTEM)
        if site is None:
            service.end_study(db, study, reason, SYSTEM)
        else:
            service.end_site(db, study, site, reason)
    show({"study": code, "site": site, "ended": True}, as_json, f"{_named(code, site)} has ended.")


def reopen(code: StudyCode, reason: Why, site: SiteCode = None, as_json: AsJson = False) -> None:
    """Open a study or a site again that has ended."""
    with transaction(ACTOR) as db:
        study = studies.study_to_manage(db, code, SYSTEM)
        if site is None:
            service.reopen_study(db, study, reason)
        else:
            service.reopen_site(db, study, site, reason)
    show({"study": code, "site": site, "ended": False}, as_json, f"{_named(code, site)} is open again.")


def register(study: typer.Typer) -> None:
    """Put the commands where people look for them."""
    study.command("end", epilog="Example: betaloop study end ADAPT --reason 'last visit held'")(end)
    study.command("reopen", epilog="Example: betaloop study reopen ADAPT --site south --reason 'ended by mistake'")(reopen)


def _named(code: str, site: str | None) -> str:
    return f"Study {code}" if site is None else f"Site {site} of study {code}"
