"""The command `betaloop export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.accounts.permissions import SYSTEM
from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, Code, bad_call, reason, say, show


def export_package(
    code: Code,
    to: Annotated[Path | None, typer.Option(help="Zip to write; CODE.zip by default.")] = None,
    sheet: Annotated[bool, typer.Option("--sheet", help="A CSV of its sessions, as `betaloop import --study` reads it.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write everything of a participant as a zipped Frictionless data package, with a script that recomputes its primary tables."""
    from app.overview.package import export_participant, export_sheet
    from app.study import repository as study

    target = to or Path(f"{code}.csv" if sheet else f"{code}.zip")
    if target.is_dir() or not target.parent.is_dir():
        raise bad_call(f"{target} cannot be written: " + ("it is a folder." if target.is_dir() else f"there is no folder {target.parent}."))
    with transaction(ACTOR) as db:
        content = (export_sheet if sheet else export_participant)(db, study.participant_by_code(db, code, SYSTEM), SYSTEM)
    try:
        target.write_bytes(content)
    except OSError as error:
        say(f"betaloop: {target} cannot be written: {reason(error)}.")
        raise typer.Exit(1) from error
    show({"path": str(target), "bytes": len(content)}, as_json, f"Wrote {target} ({len(content)} bytes).")


def register_export(app: typer.Typer) -> None:
    """Add the command."""
    app.command("export", epilog="Example: betaloop export P1 --to p1.zip")(export_package)


# The command `betaloop audit export`.


def export_trail(
    to: Annotated[Path, typer.Argument(help="CSV file to write.")],
    participant: Annotated[str, typer.Option(help="Rows of this participant alone.")] = "",
    begin: Annotated[str, typer.Option(help="First day, YYYY-MM-DD, UTC.")] = "",
    end: Annotated[str, typer.Option(help="Last day.")] = "",
    as_json: AsJson = False,
) -> None:
    """Write the audit trail as a table, newest first. The export becomes a row of the trail, even one that fails halfway."""
    from sqlalchemy import true

    from app.overview.trail import as_csv
    from app.overview.trail_scope import TrailFilter
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
                db.commit()  # rows that were written are in the trail as taken, whatever becomes of the rest
                for piece in pieces:
                    written += out.write(piece)
        except OSError as error:
            say(f"betaloop: {to} cannot be written: {reason(error)}.")
            raise typer.Exit(1) from error
    show({"path": str(to), "characters": written}, as_json, f"Wrote the audit trail to {to}.")


def register_trail(app: typer.Typer) -> None:
    """Add the command to those of the audit trail."""
    app.command("export", epilog="Example: betaloop audit export trail.csv --participant P1")(export_trail)
