"""Command `betaloop participant status`."""

from __future__ import annotations

from typing import Annotated, cast, get_args

import typer

from app.accounts.permissions import SYSTEM
from app.platform.database import transaction
from app.platform.errors import Invalid
from app.platform.terminal import ACTOR, AsJson, Code, Why, show
from app.study import repository
from app.study.participation import service
from app.study.participation.schemas import Status, StatusChange

participant_app = typer.Typer(no_args_is_help=True, help="Participants.")


@participant_app.callback()
def _participants() -> None:
    """Participants."""


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
        service.change_status(db, participant, StatusChange(status=cast(Status, status), reason=reason), SYSTEM)
    show({"participant": code, "status": status}, as_json, f"{code}: {status}.")
