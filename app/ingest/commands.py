"""Commands of phase I: `betaloop import`, and those of `betaloop ingest`: `redecode`, `names`, `resume`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from app.accounts.permissions import SYSTEM
from app.platform.bucket import bucket
from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, show
from app.settings import get_settings

ingest_app = typer.Typer(no_args_is_help=True, help="Stored uploads.")


def import_(
    path: Annotated[
        Path, typer.Argument(exists=True, dir_okay=False, help="A zip of an RC+S session folder, a Percept report, a table, an export.")
    ],
    participant: Annotated[str, typer.Option(help="Code of the participant.")],
    visit: Annotated[int | None, typer.Option(min=1, help="Number of the visit; left out, it is proposed by its date.")] = None,
    controller: Annotated[
        str | None, typer.Option(help="cdbs, rl, distilled, no_dbs, random or other; left out, sessions are proposed.")
    ] = None,
    policy: Annotated[str | None, typer.Option(help="Name or number of the policy that ran.")] = None,
    started_at: Annotated[datetime | None, typer.Option(help="Start of the session, UTC.")] = None,
    beta_unit: Annotated[str | None, typer.Option(help="Unit of a table's beta; the participant's when left out.")] = None,
    as_json: AsJson = False,
) -> None:
    """Import a file, as an upload does: with visit and controller its sessions count at once, else they wait for confirmation."""
    from app.ingest.uploads import api, service
    from app.study import repository as study
    from app.tables.sessions import Controller

    if controller is not None and controller not in set(Controller):
        raise typer.BadParameter(f"'{controller}' is none of {', '.join(Controller)}.", param_hint="--controller")
    if (store := bucket()) is not None:
        store.check_keys(get_settings())
    with transaction(ACTOR) as db, path.open("rb") as stream:
        person = study.participant_by_code(db, participant, SYSTEM)
        arm = Controller(controller) if controller is not None else None
        stated = service.state_session(db, person, visit, arm, policy, started_at)
        outcome = service.receive(db, person, stated, [service.Incoming(path.name, stream)], SYSTEM, service.BetaStated(beta_unit))
        if not outcome.usable:
            raise api.unusable(outcome)
        answer = api.upload_out(db, outcome, SYSTEM).model_dump(mode="json")
    lines = [f"{r['name']}: {s}" for r in answer["report"] for key in ("understood", "repaired", "flagged", "removed") for s in r[key]]
    show(answer, as_json, "\n".join(lines))


@ingest_app.command("redecode", epilog="Example: betaloop ingest redecode --participant P1 --dry-run")
def redecode_(
    participant: Annotated[str | None, typer.Option(help="Code of a participant; every one when left out.")] = None,
    upload_file: Annotated[int | None, typer.Option(min=1, help="Number of one file, from its upload's page.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Tell what would change, and change nothing.")] = False,
    as_json: AsJson = False,
) -> None:
    """Read stored files with the present decoder; sessions use what it gives from then on, snapshots keep what they pin."""
    from app.ingest.uploads.redecode import redecode
    from app.study import repository as study

    with transaction(ACTOR) as db:
        only = study.participant_by_code(db, participant, SYSTEM).id if participant else None
    table = Table("file", "participant", "kind", "state", "what changed" if not dry_run else "what would change")
    changes = list(redecode(only, upload_file, dry_run, ACTOR))
    for c in changes:
        table.add_row(str(c.upload_file_id), c.participant, c.kind, c.state, "\n".join(c.said))
    if as_json:
        show({"dry_run": dry_run, "files": [vars(c) for c in changes]}, True, "")
    else:
        Console().print(table)
        moved = [said for c in changes for said in c.sessions]
        typer.echo(f"Sessions whose time or dose {'would change' if dry_run else 'changed'}: {len(moved)}")
        for said in moved:
            typer.echo(f"  {said}")
        if moved:
            typer.echo("Rankings and plans that rest on them say so on their pages; make new ones.")
    if any(c.state == "failed" for c in changes):
        raise typer.Exit(1)


@ingest_app.command("names", epilog="Example: betaloop ingest names")
def names_(as_json: AsJson = False) -> None:
    """List the technical names in devices' files that this version does not know: send them to its developers after a new firmware."""
    from app.ingest.repository import unknown_names
    from ml.formats import DEVICE_NAMES

    with transaction(ACTOR) as db:
        found = unknown_names(db)
    fields = ("device", "name", "recordings", "devices", "last_upload")
    if as_json:
        show({"names": [dict(zip(fields, (*row[:4], row[4].isoformat()), strict=True)) for row in found]}, True, "")
        return
    table = Table("device", "name", "recordings", "devices", "last upload")
    for kind, name, recordings, devices, last in found:
        table.add_row(DEVICE_NAMES.get(kind, kind), name, str(recordings), str(devices), f"{last:%Y-%m-%d}")
    Console().print(table if found else "No device's file had a name that this version does not know.")


@ingest_app.command("resume", epilog="Example: betaloop ingest resume")
def resume_() -> None:
    """Resume uploads that a stop of the service cut short; the service does so itself when it starts."""
    from app.ingest.uploads.interrupted import resume

    taken = list(resume(ACTOR))
    for one in taken:
        typer.echo(f"Upload {one.upload_id}: {one.message}")
    if not taken:
        typer.echo("No upload was cut short.")
    if any(not (one.done or one.left) for one in taken):
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Put the commands where people look for them."""
    app.command("import", epilog="Example: betaloop import session.zip --participant P1 --visit 2 --controller random")(import_)
    app.add_typer(ingest_app, name="ingest")
