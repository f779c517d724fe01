"""Checks of an installation: each reports what it found, and what to do where something is wrong."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import or_, select, text
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from app.platform import files
from app.platform.audit.chain import verify
from app.platform.bucket import StoreAway, bucket
from app.platform.database import new_session, now
from app.platform.jobs import repository as jobs
from app.platform.jobs.service import NEWER_WORKER, STALE_S
from app.platform.numbers import counted
from app.platform.service_role import excess
from app.platform.upkeep.migrate import newest_revision, revision
from app.settings import get_settings
from app.tables import METADATA
from app.tables.uploads import StoredFile

LEAST_FREE_MB = 1024
MOST_NAMED = 20
MOST_CLOCK_DIFFERENCE_S = 2.0


@dataclass(frozen=True)
class Finding:
    """One check.

    Attributes:
        name: of the check. ok: whether all is well. detail: what was found. hint: what to do where it is not well.
    """

    name: str
    ok: bool
    detail: str
    hint: str = ""


def examine(hashes: bool = False) -> list[Finding]:
    """Run every check; `hashes` reads every stored file and the audit trail whole."""
    found = [_disk(), _check_closed_folders()]
    try:
        with new_session() as db:
            trail = [_trail(db)] if hashes else []
            return [*found, _schema(db), _role(db), _clock(db), _files(db, hashes), *trail, *_jobs(db)]
    except (SQLAlchemyError, RuntimeError) as error:
        reason = str(getattr(error, "orig", error)).strip().splitlines()
        detail = f"it does not answer: {reason[0] if reason else type(error).__name__}"
        return [*found, Finding("database", False, detail, "Start it, or correct BETALOOP_DATABASE_URL; `betaloop where` says which one.")]


def _schema(db: Session) -> Finding:
    has, needs = revision(db), newest_revision()
    hint = "Run `betaloop migrate`; where the database is newer than the program, install the newer betaloop."
    return Finding("database", has == needs, f"answers; schema {has or 'none'}, this betaloop needs {needs}", "" if has == needs else hint)


def _role(db: Session) -> Finding:
    beyond = excess(db.connection())
    hint = "Give the service a role that owns nothing (docs/operations.md, Database roles), and name the owner's in BETALOOP_OWNER_URL."
    role = db.scalar(text("select current_user"))
    detail = f"{role} {', '.join(beyond)}" if beyond else f"{role} owns nothing and cannot change the audit trail"
    return Finding("database role", not beyond, detail, hint if beyond else "")


def _trail(db: Session) -> Finding:
    found = verify(db)
    hint = "" if found.whole else "See `betaloop audit verify`; somebody changed the trail past the service."
    accepted = f", {counted(len(found.accepted), 'false time')} looked into" if found.accepted else ""
    detail = f"{found.links} links, sealed up to {found.sealed_to}{accepted}" if found.whole else f"broken at {len(found.breaks)} places"
    return Finding("audit trail", found.whole, detail, hint)


def _clock(db: Session) -> Finding:
    before = now()
    theirs = db.scalar(text("select clock_timestamp()"))
    after = now()
    apart = max((before - theirs).total_seconds(), (theirs - after).total_seconds(), 0.0) if theirs else 0.0
    ok = apart <= MOST_CLOCK_DIFFERENCE_S
    return Finding("clock", ok, f"{apart:.1f} s apart from the database's", "" if ok else "Set both machines' clocks by NTP.")


def _files(db: Session, hashes: bool) -> Finding:
    rows = db.execute(text("select sha256, size from stored_file order by sha256")).all()
    try:
        if (store := bucket()) is not None:
            store.check_keys(get_settings())
    except (StoreAway, RuntimeError) as error:
        return Finding("files", False, str(error), "Check BETALOOP_FILES_URL, the bucket's rights, and the folder secrets.")
    bad = [row.sha256 for row in rows if not files.is_whole(row.sha256, row.size, hashes)]
    checked = "hashes" if hashes else "sizes"
    if bad:
        detail = f"{len(bad)} of {len(rows)} stored files are missing or damaged, the first {bad[0]}{_owners_of(db, bad)}"
        hint = (
            "What was uploaded is made anew when the same file is uploaded once more for its participant, "
            "a buffer snapshot by the next job on the data that it was made of; the rest comes back from a backup (`betaloop restore`)."
        )
        return Finding("files", False, detail, hint)
    return Finding("files", True, f"{len(rows)} stored files, {checked} checked")


def _owners_of(db: Session, bad: list[str]) -> str:
    """List what names stored files, as tables and numbers: by these they can be looked up and sent again."""
    found = []
    for table in METADATA.sorted_tables:
        columns = [key.parent for key in table.foreign_keys if key.column.table.name == StoredFile.__tablename__]
        if not columns:
            continue
        query = select(table.c.id).where(or_(*(column.in_(bad) for column in columns))).order_by(table.c.id)
        if numbers := db.scalars(query.limit(MOST_NAMED + 1)).all():
            more = " and more" if len(numbers) > MOST_NAMED else ""
            found.append(f"{table.name.replace('_', ' ')} {', '.join(map(str, numbers[:MOST_NAMED]))}{more}")
    return f" (needed by {'; '.join(found)})" if found else ""


def _jobs(db: Session) -> Iterator[Finding]:
    live, workers = jobs.live_ids(db), jobs.live_workers(db, STALE_S)
    detail, hint = f"{len(live)} waiting or running, {len(workers)} live workers", ""
    if len(versions := sorted({worker.code_version for worker in workers})) > 1:
        detail += f" of versions {', '.join(versions)}"
    beyond, newest, spoken = jobs.count_unserved(db, STALE_S)
    if live and not workers:
        hint = "Start one with `betaloop worker`; jobs go on where they were."
    elif beyond:
        detail += f"; {beyond} need a newer worker: job protocol {newest}, and the live workers speak {spoken}"
        hint = NEWER_WORKER
    yield Finding("jobs", not hint, detail, hint)


def _disk() -> Finding:
    free = _free_mb(get_settings().data_dir)
    ok = free >= LEAST_FREE_MB
    return Finding("disk", ok, f"{free:.0f} MiB free", "" if ok else f"Make room: uploads need at least {LEAST_FREE_MB} MiB.")


def _free_mb(folder: Path) -> float:
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free / (1 << 20)


def _check_closed_folders() -> Finding:
    settings = get_settings()
    folders = [settings.files_dir, settings.jobs_dir, settings.data_dir / "secrets"]
    standing_open = [str(f) for f in folders if f.is_dir() and f.stat().st_mode & 0o077]
    if standing_open:
        return Finding("folders", False, f"open to other users: {', '.join(standing_open)}", "Run `betaloop migrate`, which closes them.")
    return Finding("folders", True, "closed to other users of the machine")
