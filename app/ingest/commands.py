"""Commands of phase I: `betaloop import`, and those of `betaloop ingest`: `redecode`, `names`, `resume`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from app.accounts.permissions import SYSTEM
from app.platform.bucket import bucket
from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, show
from app.settings import get_settings

if TYPE_CHECKING:
    from app.ingest.study_import import StudyReport

ingest_app = typer.Typer(no_args_is_help=True, help="Stored uploads.")


def import_(
    paths: Annotated[
        list[Path],
        typer.Argument(exists=True, help="A zip of an RC+S session folder, a Percept report, a table, an export; with --study folders."),
    ],
    participant: Annotated[str | None, typer.Option(help="Code of the participant; with --study the sheet names them.")] = None,
    visit: Annotated[int | None, typer.Option(min=1, help="Number of the visit; by default proposed by its date.")] = None,
    controller: Annotated[
        str | None, typer.Option(help="cdbs, rl, distilled, no_dbs, random or other; by default sessions are proposed.")
    ] = None,
    policy: Annotated[str | None, typer.Option(help="Name or number of the policy that ran.")] = None,
    started_at: Annotated[datetime | None, typer.Option(help="Start of the session, UTC.")] = None,
    beta_unit: Annotated[str | None, typer.Option(help="Unit of a table's beta; the participant's by default.")] = None,
    study: Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="Sheet with a row per session, CSV or xlsx.")] = None,
    zone: Annotated[str | None, typer.Option(help="Zone of the sheet's times, such as Europe/Berlin or +01:00.")] = None,
    dictionary: Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="The sheet's REDCap data dictionary.")] = None,
    column: Annotated[list[str] | None, typer.Option(help="Meaning and header of a column, such as start=Begin; repeated.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what --study would do, and change nothing.")] = False,
    as_json: AsJson = False,
) -> None:
    """Import a file, or with --study folders of files and a sheet with a row per session.

    A file's sessions count at once with visit and controller, else they wait for confirmation. A study's sessions are those of the sheet.
    """
    if (store := bucket()) is not None:
        store.check_keys(get_settings())
    if study is not None:
        if participant or visit or controller or policy or started_at or beta_unit:
            raise typer.BadParameter("With --study the sheet says what each session is.", param_hint="--study")
        _import_study(paths, study, zone, dictionary, column or [], dry_run, as_json)
        return
    if participant is None or len(paths) != 1 or paths[0].is_dir():
        raise typer.BadParameter("Name one file and --participant, or folders and --study.", param_hint="PATHS")
    _import_file(paths[0], participant, visit, controller, policy, started_at, beta_unit, as_json)


def _import_file(
    path: Path,
    participant: str,
    visit: int | None,
    controller: str | None,
    policy: str | None,
    started_at: datetime | None,
    beta_unit: str | None,
    as_json: bool,
) -> None:
    from app.ingest.uploads import api, service
    from app.study import repository as study
    from app.tables.sessions import Controller

    if controller is not None and controller not in set(Controller):
        raise typer.BadParameter(f"'{controller}' is none of {', '.join(Controller)}.", param_hint="--controller")
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


def _import_study(
    folders: list[Path], sheet: Path, zone: str | None, dictionary: Path | None, columns: list[str], dry_run: bool, as_json: bool
) -> None:  # fmt: skip
    from app.ingest.study_import import import_study
    from ml.formats import UndecodableFile
    from ml.formats.studies.sheet import read_sheet
    from ml.formats.tables.cells.dates import zone_named

    named = zone_named(zone) if zone is not None else None
    if zone is not None and named is None:
        raise typer.BadParameter(f"'{zone}' is neither an offset nor a zone with a name.", param_hint="--zone")
    if wrong := [c for c in columns if "=" not in c]:
        raise typer.BadParameter(f"'{wrong[0]}' is not written as MEANING=HEADER.", param_hint="--column")
    try:
        meaning = dict(c.split("=", 1) for c in columns)
        rows = read_sheet(sheet.read_bytes(), named, dictionary.read_bytes() if dictionary else None, meaning)
    except UndecodableFile as error:
        raise typer.BadParameter(f"{error.what} ({error.where}). {error.hint}", param_hint="--study") from error
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=None)
        report = import_study(
            folders, rows, SYSTEM, ACTOR, dry_run, lambda n, of, name: bar.update(task, completed=n, total=of, description=name[-40:])
        )  # fmt: skip
    if as_json:
        show({**vars(report), "ignored_columns": rows.ignored}, True, "")
    else:
        _print_study(report, rows.ignored)
    if report.problems or report.rows or report.files:
        raise typer.Exit(1)


def _print_study(report: StudyReport, columns: list[str]) -> None:
    listed = Table("line", "participant", "file", "would be done" if report.dry_run else "done")
    for line, code, file, said in report.sessions:
        listed.add_row(str(line), code, file, said)
    Console().print(listed)
    for title, found in (
        ("Rows without a session", [(f"line {line}", why) for line, why in report.rows]),
        ("Files without a row", report.files),
        ("Files that could not be read", report.problems),
    ):
        typer.echo(f"{title}: {len(found)}")
        for name, why in found:
            typer.echo(f"  {name}: {why}")
    if report.notes:
        typer.echo(f"Notes of {report.notes} rows were not kept: they may name people.")
    if columns:
        typer.echo(f"Columns of no use: {', '.join(columns)}")
    typer.echo("Nothing was changed." if report.dry_run or not report.changed else f"Changed: {report.changed} files, visits and sessions.")


@ingest_app.command("redecode", epilog="Example: betaloop ingest redecode --participant P1 --dry-run")
def redecode_(
    participant: Annotated[str | None, typer.Option(help="Code of a participant; every one by default.")] = None,
    upload_file: Annotated[int | None, typer.Option(min=1, help="Number of one file, from its upload's page.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would change, and change nothing.")] = False,
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
