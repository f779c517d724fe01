"""Place of a data folder's embedded database: chosen once, recorded in the data folder, and obeyed from then on.

The server's user must be able to enter the place. Under a closed folder (root's home, say) the database goes to `/var/lib/betaloop`, so
that nothing need be opened. The record `postgres.location` holds that path, or `postgres` for a database inside the data folder, which
may then be moved as a whole.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import subprocess
import time
from pathlib import Path

from app.platform.embedded.system_user import SystemUser

SYSTEM_FOLDER = Path("/var/lib/betaloop")
_SOCKET_PATH_LIMIT = 90  # bytes; PostgreSQL appends the name of its file
_PLAIN = re.compile(r"[\w./+-]+")


def recorded(asked: Path) -> Path | None:
    """Return the place that the data folder names, or None before the first start has written it down."""
    try:
        text = record_path(asked).read_text().removesuffix("\n")
    except FileNotFoundError:
        return None
    return asked.parent / text if text else None


def record_path(asked: Path) -> Path:
    """Return the path of the file that names the place."""
    return asked.with_name(f"{asked.name}.location")


def record(asked: Path, place: Path) -> None:
    """Write the place down for good, before anything is stored in it."""
    path = record_path(asked)
    draft = path.with_name(f"{path.name}.part")
    with draft.open("w") as out:
        out.write(f"{asked.name if place == asked else place}\n")
        out.flush()
        os.fsync(out.fileno())
    draft.replace(path)
    _sync(path.parent)


def existing(asked: Path, user: SystemUser | None) -> Path | None:
    """Find the place of the data folder's database; None if it has none yet.

    Raises:
        RuntimeError: the recorded database is gone, there are two, it belongs to another user, or the server's user cannot reach it.
    """
    place = recorded(asked)
    if place is None:
        if not has_database(asked):
            return None
        place = asked  # of a first start that was killed before it wrote the place down
    if not has_database(place):
        raise RuntimeError(
            f"The database of {asked.parent} was in {place}, as {record_path(asked)} says, and is not there any more. Restore that folder"
            f" from a backup. Only to begin again with an empty database: remove {record_path(asked)}."
        )
    if place != asked and has_database(asked):
        raise RuntimeError(
            f"There are two databases for {asked.parent}: {place}, which {record_path(asked)} names, and {asked}. betaloop does not choose."
            f" Find out which one holds your study and move the other away; if {asked} is the right one, remove {record_path(asked)} too."
        )
    _check_owner(place, user)
    if user is not None:
        _check_reachable(asked, place, user)
    return place


def choose(asked: Path, user: SystemUser | None) -> Path:
    """Choose a place for a new database: the data folder, or one outside if the server's user cannot enter the data folder."""
    if user is None or may_enter(asked.parent, user):
        return asked
    return SYSTEM_FOLDER / _short_name(asked) / "postgres"


def set_aside(asked: Path, place: Path) -> None:
    """Move away what a removed data folder of the same path left outside, so that its rows do not come back under a new one.

    Raises:
        RuntimeError: the data folder is not new, so that the database outside may be its own.
    """
    if (asked.parent / "files").exists():
        raise RuntimeError(
            f"{asked.parent} holds stored files but does not say where its database is. There is one in {place}, made for a"
            f" data folder of this path. If they belong together: echo {place} > {record_path(asked)}. If not, move {place.parent} away."
        )
    place.rename(place.with_name(f"{place.name}-left-{time.time_ns()}"))


def has_database(folder: Path) -> bool:
    """Check if the folder holds PostgreSQL data.

    Raises:
        RuntimeError: this process may not look into it.
    """
    try:
        return (folder / "PG_VERSION").stat().st_size > 0
    except (FileNotFoundError, NotADirectoryError):
        return False
    except PermissionError as error:
        raise RuntimeError(
            f"{folder} cannot be looked into, because it belongs to another user: start betaloop as the user who started it first"
            " (root, where root did)."
        ) from error


def may_enter(folder: Path, user: SystemUser) -> bool:
    """Ask the kernel if a user may enter the folder and all above it."""
    program = shutil.which("test", path="/usr/bin:/bin") or "test"
    done = subprocess.run([program, "-x", str(folder)], user=user.uid, group=user.gid, extra_groups=[], cwd="/", check=False)
    return done.returncode == 0


def private_folder(path: Path, user: SystemUser | None) -> None:
    """Make a folder that only its owner, the server's user, may enter; refuse a folder or link of another user.

    Raises:
        RuntimeError: something that is not ours has this name already.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        path.mkdir(mode=0o700)
    except FileExistsError:
        found = path.lstat()
        ours = {0, os.geteuid()} | ({user.uid} if user else set())
        if not stat.S_ISDIR(found.st_mode) or found.st_uid not in ours:
            raise RuntimeError(f"{path} is needed for PostgreSQL's socket and belongs to another user. Remove it.") from None
    if user is not None:
        os.chown(path, user.uid, user.gid)
    path.chmod(0o700)


def socket_folder(data: Path) -> Path:
    """Return the folder of the server's socket: next to its data, or with a short plain name if libpq could not use that path.

    A socket's path has about 107 bytes at most. Commas, quotes, spaces and colons mean something in connection strings.
    """
    beside = data.with_name(f"{data.name}.socket")
    if _PLAIN.fullmatch(str(beside)) and len(os.fsencode(beside)) <= _SOCKET_PATH_LIMIT:
        return beside
    # not the folder that TMPDIR names: every process must find the same; `private_folder` refuses another user's
    return Path("/tmp") / f"betaloop-{_short_name(data)}"  # noqa: S108


def open_folder(path: Path) -> None:
    """Make a system folder through which every user may pass.

    Raises:
        RuntimeError: it cannot be made; the message says what to do instead.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        path.chmod(0o711)
    except OSError as error:
        raise RuntimeError(
            f"The data folder is closed to PostgreSQL's user, and {path} cannot be made instead: {error.strerror}. Choose a data folder"
            " that other users may pass through (BETALOOP_DATA_DIR), or set BETALOOP_DATABASE_URL."
        ) from error


def _short_name(path: Path) -> str:
    return hashlib.sha256(os.fsencode(path)).hexdigest()[:12]


def _check_owner(place: Path, user: SystemUser | None) -> None:
    owner, wanted = place.stat().st_uid, user.uid if user else os.geteuid()
    if owner != wanted:
        name = user.name if user else "you"
        raise RuntimeError(
            f"The database in {place} belongs to the user with number {owner}, and PostgreSQL would run as '{name}' (number {wanted})."
            f" Start betaloop as before (as root: with BETALOOP_SERVER_USER naming that user), or give it away: chown -R {wanted} {place}"
        )


def _check_reachable(asked: Path, place: Path, user: SystemUser) -> None:
    if may_enter(place, user):
        return
    closed = next(p for p in [*reversed(place.parents), place] if not may_enter(p, user))
    raise RuntimeError(
        f"The database of {asked.parent} is in {place}, and PostgreSQL, which runs as the system user '{user.name}', can no longer get"
        f" there: {closed} is closed (mode {stat.S_IMODE(closed.stat().st_mode):o}). Open it: chmod o+x {closed}."
        " Nothing was changed, and no other database was made."
    )


def _sync(folder: Path) -> None:
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
