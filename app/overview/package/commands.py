"""The command `betaloop export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.accounts.permissions import SYSTEM
from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, Code, bad_call, reason, say, show


def export(
    code: Code,
    to: Annotated[Path | None, typer.Option(help="Zip to write; CODE.zip when left out.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write everything of a participant as a zipped Frictionless data package, with a script that recomputes its primary tables."""
    from app.overview.package.export import export_participant
    from app.study import repository as study

    target = to or Path(f"{code}.zip")
    if target.is_dir() or not target.parent.is_dir():
        raise bad_call(f"{target} cannot be written: " + ("it is a folder." if target.is_dir() else f"there is no folder {target.parent}."))
    with transaction(ACTOR) as db:
        content = export_participant(db, study.participant_by_code(db, code, SYSTEM), SYSTEM)
    try:
        target.write_bytes(content)
    except OSError as error:
        say(f"betaloop: {target} cannot be written: {reason(error)}.")
        raise typer.Exit(1) from error
    show({"path": str(target), "bytes": len(content)}, as_json, f"Wrote {target} ({len(content)} bytes).")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("export", epilog="Example: betaloop export P1 --to p1.zip")(export)
