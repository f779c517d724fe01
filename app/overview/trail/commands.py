"""The command `betaloop audit export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.accounts.permissions import SYSTEM
from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, bad_call, reason, say, show


def export(
    to: Annotated[Path, typer.Argument(help="CSV file to write.")],
    participant: Annotated[str, typer.Option(help="Rows of this participant alone.")] = "",
    begin: Annotated[str, typer.Option(help="First day, YYYY-MM-DD, UTC.")] = "",
    end: Annotated[str, typer.Option(help="Last day.")] = "",
    as_json: AsJson = False,
) -> None:
    """Write the audit trail as a table, newest first. The export becomes a row of the trail, even one that fails halfway."""
    from sqlalchemy import true

    from app.overview.trail.export import as_csv
    from app.overview.trail.schemas import TrailFilter
    from app.platform.web.forms import parse

    typed = {"participant": participant, "begin": begin, "end": end}
    wanted = parse(TrailFilter, {name: value for name, value in typed.items() if value})
    if to.is_dir() or not to.parent.is_dir():
        raise bad_call(f"{to} cannot be written: " + ("it is a folder." if to.is_dir() else f"there is no folder {to.parent}."))
    written = 0
    with transaction(ACTOR) as db:
        try:
            with to.open("w", encoding="utf-8") as out:
                pieces = as_csv(db, true(), wanted, SYSTEM)
                db.commit()  # rows that were written stand in the trail as taken, whatever becomes of the rest
                for piece in pieces:
                    written += out.write(piece)
        except OSError as error:
            say(f"betaloop: {to} cannot be written: {reason(error)}.")
            raise typer.Exit(1) from error
    show({"path": str(to), "characters": written}, as_json, f"Wrote the audit trail to {to}.")


def register(app: typer.Typer) -> None:
    """Add the command to those of the audit trail."""
    app.command("export", epilog="Example: betaloop audit export trail.csv --participant P1")(export)
