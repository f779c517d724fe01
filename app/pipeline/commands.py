"""The command `betaloop next-generation`."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from app.accounts.permissions import SYSTEM
from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, Code


def next_generation(
    code: Code,
    preset: Annotated[Literal["full", "quick"], typer.Option(help="'full' for a study, 'quick' for a first look.")] = "full",
    wait: Annotated[bool, typer.Option(help="Show progress until the job has ended.")] = True,
    as_json: AsJson = False,
) -> None:
    """Continue from the policies that did best in their sessions, train new ones, distil, evaluate and rank. A worker must be running."""
    from app.pipeline.next_generation import start
    from app.pipeline.params import NextGenerationParams
    from app.platform.jobs.watch import follow
    from app.study import repository as study

    with transaction(ACTOR) as db:
        job_id = start(db, study.participant_by_code(db, code, SYSTEM), NextGenerationParams.model_validate({"preset": preset}), SYSTEM).id
    follow(job_id, wait, as_json)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("next-generation", epilog="Example: betaloop next-generation P1 --preset quick")(next_generation)
