"""Commands of upkeep: `betaloop migrate`, `where`, `backup-key`, `backup`, `restore` and `doctor`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.platform.database import database_place, transaction
from app.platform.jobs.service import take_back
from app.platform.numbers import counted
from app.platform.terminal import AsJson, print_line, show
from app.platform.upkeep import backup as backups
from app.platform.upkeep.doctor import examine
from app.platform.upkeep.migrate import migrate as bring_up_to_date
from app.settings import get_settings

app = typer.Typer(no_args_is_help=True)

KeyFile = Annotated[
    Path, typer.Option(help="File with the key of the backup (`betaloop backup-key`); neither next to it nor in the data folder.")
]


@app.command(epilog="Example: betaloop migrate")
def migrate() -> None:
    """Bring the database to the newest schema."""
    bring_up_to_date()
    print_line("The database is up to date.")


@app.command(epilog="Example: betaloop where")
def where(as_json: AsJson = False) -> None:
    """Show the places of the database, the stored files and the keys of this installation; nothing is started."""
    settings = get_settings()
    data_dir = settings.data_dir.resolve()
    result = {"data_folder": str(data_dir), "database": database_place(), "files": str(data_dir / "files")}
    if settings.files_url:
        at = f" at {settings.files_endpoint}" if settings.files_endpoint else ""
        result |= {"files": f"{settings.files_url}{at}", "copies_of_files": str(data_dir / "files")}
    result |= {"keys": str(data_dir / "secrets")}
    show(result, as_json, "\n".join(f"{name.replace('_', ' ')}: {value}" for name, value in result.items()))


@app.command("take-back-jobs", epilog="Example: betaloop take-back-jobs")
def take_back_jobs() -> None:
    """Let this version run the unfinished jobs of a newer one, after an upgrade that was given up. Stop the newer workers first."""
    with transaction("command line") as db:
        moved = take_back(db)
    print_line(f"{counted(moved, 'job')} of a newer version will run in this one.")


@app.command("backup-key", epilog="Example: betaloop backup-key /media/key/betaloop.key")
def backup_key(path: Annotated[Path, typer.Argument(help="New file for the key.")]) -> None:
    """Make a key for backups. Without it no backup can be opened: keep a second copy of it."""
    backups.make_key(path)
    print_line(f"{path}: keep it apart from the backups, and a second copy of it elsewhere.")


@app.command(epilog="Example: betaloop backup /mnt/backups/2026-11-22 --key-file /media/key/betaloop.key")
def backup(folder: Annotated[Path, typer.Argument(help="New folder for the backup.")], key_file: KeyFile, as_json: AsJson = False) -> None:
    """Back up database, stored files and keys, encrypted; the service may go on meanwhile. Exit code 1 where stored files are damaged."""
    manifest = backups.backup(folder, key_file)
    size = sum(part["bytes"] for part in manifest["parts"].values())
    said = f"{folder}: {manifest['files']} stored files, {size / (1 << 20):.1f} MiB, encrypted."
    show(manifest, as_json, "\n".join([said, *_damaged(manifest["damaged"], "All else is in this backup.")]))
    if manifest["damaged"]:
        raise typer.Exit(1)


@app.command(epilog="Example: betaloop restore /mnt/backups/2026-11-22 --key-file /media/key/betaloop.key")
def restore(folder: Annotated[Path, typer.Argument(help="Folder of the backup.")], key_file: KeyFile, as_json: AsJson = False) -> None:
    """Bring a backup back into an empty installation, and check every stored file. Stop the service first."""
    done = backups.restore(folder, key_file)
    result = {"made_at": done.made_at, "files": done.files, "rows": done.tables, "damaged": done.damaged}
    said = f"Restored the backup of {done.made_at}: {sum(done.tables.values())} rows, {done.files} files."
    show(result, as_json, "\n".join([said, *_damaged(done.damaged, "They were so when the backup was made.")]))


def _damaged(hashes: list[str], rest: str) -> list[str]:
    """List the stored files that are missing or damaged, as lines of text; none if all are whole."""
    if not hashes:
        return []
    hint = f"{rest} Send their files once more, or take them from an older backup; `betaloop doctor --hashes` names what is still missing."
    return [f"{len(hashes)} stored files are missing or damaged: {', '.join(hashes)}.", hint]


@app.command(epilog="Example: betaloop doctor --hashes")
def doctor(
    hashes: Annotated[bool, typer.Option(help="Read every stored file and compare its hash; may take minutes.")] = False,
    as_json: AsJson = False,
) -> None:
    """Look whether the installation is in order: database, files, jobs, disk, clock. Exit code 1 where something is not."""
    findings = examine(hashes)
    lines = (f"{'ok  ' if f.ok else 'FAIL'} {f.name}: {f.detail}{'. ' + f.hint if f.hint else ''}" for f in findings)
    show([vars(f) for f in findings], as_json, "\n".join(lines))
    if not all(f.ok for f in findings):
        raise typer.Exit(1)
