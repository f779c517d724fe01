"""Command `betaloop participant status`."""

from __future__ import annotations

from typing import Annotated, cast, get_args

import typer

from app.accounts import studies
from app.accounts.permissions import SYSTEM
from app.platform.database import transaction
from app.platform.errors import Invalid
from app.platform.terminal import ACTOR, AsJson, Code, Why, show
from app.study import participation, repository
from app.study.participation import Status, StatusChange

participant_app = typer.Typer(no_args_is_help=True, help="Participants.")


@participant_app.callback()
def _participants() -> None:
    """Group the commands for participants."""


@participant_app.command("status", epilog="Example: betaloop participant status P1 withdrawn --reason 'moved away'")
def status_(
    code: Code,
    status: Annotated[str, typer.Argument(help="active, completed or withdrawn.")],
    reason: Why,
    as_json: AsJson = False,
) -> None:
    """Say that a participant has completed the study, has withdrawn, or takes part again; a withdrawal cancels running jobs."""
    if status not in get_args(Status):
        raise Invalid(f"{status!r} is no status.", f"Known: {', '.join(get_args(Status))}.")
    with transaction(ACTOR) as db:
        participant = repository.participant_by_code(db, code, SYSTEM)
        participation.change_status(db, participant, StatusChange(status=cast(Status, status), reason=reason), SYSTEM)
    show({"participant": code, "status": status}, as_json, f"{code}: {status}.")


# Commands `betaloop study end` and `betaloop study reopen`.

StudyCode = Annotated[str, typer.Argument(help="Code of the study.")]
SiteCode = Annotated[str | None, typer.Option("--site", help="Code of a site; the whole study by default.")]


def end(code: StudyCode, reason: Why, site: SiteCode = None, as_json: AsJson = False) -> None:
    """End a study, in which nothing changes then, or one of its sites, which then takes neither enrolments nor uploads."""
    with transaction(ACTOR) as db:
        study = studies.study_to_manage(db, code, SYSTEM)
        if site is None:
            participation.end_study(db, study, reason, SYSTEM)
        else:
            participation.end_site(db, study, site, reason)
    show({"study": code, "site": site, "ended": True}, as_json, f"{_named(code, site)} has ended.")


def reopen(code: StudyCode, reason: Why, site: SiteCode = None, as_json: AsJson = False) -> None:
    """Open a study or a site again that has ended."""
    with transaction(ACTOR) as db:
        study = studies.study_to_manage(db, code, SYSTEM)
        if site is None:
            participation.reopen_study(db, study, reason)
        else:
            participation.reopen_site(db, study, site, reason)
    show({"study": code, "site": site, "ended": False}, as_json, f"{_named(code, site)} is open again.")


def register(study: typer.Typer) -> None:
    """Put the commands where people look for them."""
    study.command("end", epilog="Example: betaloop study end ADAPT --reason 'last visit held'")(end)
    study.command("reopen", epilog="Example: betaloop study reopen ADAPT --site south --reason 'ended by mistake'")(reopen)


def _named(code: str, site: str | None) -> str:
    return f"Study {code}" if site is None else f"Site {site} of study {code}"
