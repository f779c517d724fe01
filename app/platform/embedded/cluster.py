"""An empty database cluster, made once per data folder by PostgreSQL's own `initdb`."""

from __future__ import annotations

import os
import pwd
import shutil
from pathlib import Path

from app.platform.embedded.programs import Programs

ADMIN = "postgres"
_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108
_ENOUGH_SHARED_MEMORY = 32 << 20
"""Free bytes below which parallel queries could end in a bus error; containers often mount 64 MiB."""


def make_cluster(data: Path, programs: Programs) -> None:
    """Make an empty cluster next to its place and move it there when complete, so that a kill leaves no partial one.

    Raises:
        RuntimeError: the server's user is unknown to this machine, or `initdb` failed; the message says what to do.
    """
    _require_known_user(programs)
    draft = data.with_name(f"{data.name}.new")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(mode=0o700)
    if programs.user:
        os.chown(draft, programs.user.uid, programs.user.gid)
    # trust only until the first start, behind a closed socket folder: `Access.ensure` sets passwords and rules
    done = programs.run("initdb", "--auth=trust", "--encoding=utf8", "--locale=C.UTF-8", "-U", ADMIN, *shared_memory(), "-D", str(draft))
    if done.returncode != 0:
        raise RuntimeError(f"PostgreSQL could not make a database in {draft}. It says: {done.stdout.strip()}")
    draft.rename(data)


def shared_memory() -> list[str]:
    """Return the options by which a server does without the machine's shared memory where that is too small, else none."""
    try:
        enough = shutil.disk_usage(_SHARED_MEMORY).free >= _ENOUGH_SHARED_MEMORY
    except OSError:
        enough = False
    return [] if enough else ["-c", "dynamic_shared_memory_type=mmap"]


def _require_known_user(programs: Programs) -> None:
    number = programs.user.uid if programs.user else os.geteuid()
    try:
        pwd.getpwuid(number)
    except KeyError:
        raise RuntimeError(
            f"PostgreSQL makes no database for user number {number}, who has no entry in /etc/passwd. Start betaloop as a user who has"
            " one (in a container: a user of its image), or set BETALOOP_DATABASE_URL to a PostgreSQL of your own."
        ) from None
