"""The system user under which PostgreSQL runs when root starts betaloop, because PostgreSQL refuses to run as root."""

from __future__ import annotations

import fcntl
import grp
import os
import pwd
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_LOCK_FOLDERS = ("/run", "/var/lock", "/tmp")  # noqa: S108
_PASSWORD_FILE_BUSY = (1, 10)  # exit codes of useradd: /etc/passwd or /etc/group could not be changed
_BUSY_WAIT_S = 20.0
_NAME = re.compile(r"[a-z_][a-z0-9_-]{0,31}")


@dataclass(frozen=True)
class SystemUser:
    """A user of this machine."""

    name: str
    uid: int
    gid: int


def system_user(name: str) -> SystemUser:
    """Find the system user of this name, or make it; processes that start at once wait for each other.

    Raises:
        RuntimeError: the name cannot be used, or the user does not exist and cannot be made; the message says what to do.
    """
    if not _NAME.fullmatch(name):
        raise RuntimeError(
            f"BETALOOP_SERVER_USER is '{name}', which cannot be the name of a system user: use a-z, 0-9, - and _, 32 at most."
        )
    with machine_lock("betaloop-system-user"):
        user = _find(name)
        if user is None:
            _make(name)
            user = _find(name)
        if user is None:
            raise _cannot_make(name, "'useradd' reported no error, yet the user cannot be found afterwards")
    if user.uid == 0:
        raise RuntimeError(f"BETALOOP_SERVER_USER is '{name}', which is root: PostgreSQL does not run as root. Name another user.")
    return user


@contextmanager
def machine_lock(name: str) -> Iterator[None]:
    """Take a lock that every process of this machine shares, whatever its data folder."""
    fd = _lock_file(name)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def _lock_file(name: str) -> int:
    problems = []
    for folder in _LOCK_FOLDERS:
        try:
            # no link is followed: others may write into the last of these folders
            return os.open(Path(folder) / f"{name}.lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            problems.append(str(error))
    raise RuntimeError(f"betaloop needs a lock file in one of {', '.join(_LOCK_FOLDERS)} and can write into none: {'; '.join(problems)}")


def _find(name: str) -> SystemUser | None:
    try:
        entry = pwd.getpwnam(name)
        known = pwd.getpwuid(entry.pw_uid)  # PostgreSQL looks its user up by number
    except KeyError:
        return None
    return SystemUser(name, known.pw_uid, entry.pw_gid)


def _make(name: str) -> None:
    program = shutil.which("useradd", path=os.pathsep.join([os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"]))
    if program is None:
        raise _cannot_make(name, "this machine has no 'useradd'")
    group = ["--gid", name] if _group_exists(name) else ["--user-group"]
    command = [program, "--system", "--no-create-home", "--home-dir", "/nonexistent", "--shell", "/usr/sbin/nologin", *group, name]
    deadline = time.monotonic() + _BUSY_WAIT_S
    while True:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0 or _find(name) is not None:
            return
        # another program may be changing the same files at this moment; a read-only /etc stays read-only
        may_pass = done.returncode in _PASSWORD_FILE_BUSY and os.access("/etc", os.W_OK)
        if not may_pass or time.monotonic() > deadline:
            raise _cannot_make(name, done.stderr.strip() or f"'useradd' ended with code {done.returncode}")
        time.sleep(0.5)


def _group_exists(name: str) -> bool:
    try:
        grp.getgrnam(name)
    except KeyError:
        return False
    return True


def _cannot_make(name: str, why: str) -> RuntimeError:
    return RuntimeError(
        f"PostgreSQL does not run as root, and the system user '{name}' under which betaloop would run it does not exist and cannot be"
        f" made: {why}. Do one of these: make the user (useradd --system {name}); name a user that exists in BETALOOP_SERVER_USER;"
        " start betaloop as another user than root; or set BETALOOP_DATABASE_URL to a PostgreSQL of your own."
    )
