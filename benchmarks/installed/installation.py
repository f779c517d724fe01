"""A whole installation in a folder of its own: webs, workers and PostgreSQL as processes that are killed, watched and stopped."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote

import httpx2 as httpx
import psutil
import psycopg

from app.platform.embedded.server import EmbeddedPostgres
from app.platform.embedded.system_user import system_user
from app.settings import get_settings

ROOT = Path(__file__).resolve().parents[2]
PASSWORD = "four words for a measurement"
STARTED_S, STOPPED_S = 90.0, 30.0
PASSED_ON = ("BETALOOP_SERVER_USER", "BETALOOP_JOB_NICENESS")
"""Settings of the caller's environment that hold for the installation too."""
_FORKING = "app.platform.jobs.children.fork_server"
_PREPARE = """
import json, sys
from app.accounts import service
from app.tables.accounts import Role
from app.platform.database import transaction
from app.platform.upkeep.migrate import migrate
migrate()
people, password = json.loads(sys.argv[1])
with transaction("measurement") as db:
    for address, role in people.items():
        service.add_user(db, address, Role(role), password)
    tokens = {address: service.create_token(db, address, "measurement") for address in people}
print(json.dumps(tokens))
"""


class TooLate(RuntimeError):
    """Something did not happen within its time; says what was waited for, and the end of the logs."""


class Server(Protocol):
    """The PostgreSQL of an installation."""

    def pid(self) -> int:
        """Find the process of its postmaster."""

    def admin_conninfo(self, database: str = "postgres") -> str:
        """Return what libpq connects with as superuser."""

    def remove(self) -> None:
        """Stop it and delete its data."""


class OwnPostgres:
    """The machine's own PostgreSQL (Debian's), in a folder, with the two roles of docs/operations.md; betaloop gets addresses alone.

    Args:
        folder: its new folder, which its user may pass through.
    """

    def __init__(self, folder: Path) -> None:
        found = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
        if not found:
            raise RuntimeError("this machine has no PostgreSQL of its own (/usr/lib/postgresql)")
        self._bin, self.data = found[-1], folder / "server"
        self._user = system_user(get_settings().server_user) if os.geteuid() == 0 else None
        self.data.mkdir(mode=0o700)
        if self._user:
            os.chown(self.data, self._user.uid, self._user.gid)
        self._run("initdb", "--auth=trust", "--encoding=utf8", "--locale=C.UTF-8", "-U", "postgres", "-D", str(self.data / "db"))
        self.start()
        with psycopg.connect(self.admin_conninfo(), autocommit=True) as connection:
            connection.execute("create role betaloop_owner login")
            connection.execute("create role betaloop_service login")
            connection.execute("create database betaloop owner betaloop_owner")

    def start(self) -> None:
        """Start it, as its keeper does after it was killed."""
        for _ in range(20):
            if self._run(
                "pg_ctl", "-D", str(self.data / "db"), "-w", "-l", str(self.data / "log"), "-o", self._options(), "start", check=False
            ):
                return
            time.sleep(0.5)  # orphans of a killed postmaster hold its memory for a moment
        raise RuntimeError(f"PostgreSQL does not start:\n{(self.data / 'log').read_text()[-2000:]}")

    def url(self, role: str) -> str:
        """Return its address for a role of betaloop."""
        return f"postgresql://{role}@/betaloop?host={quote(str(self.data), safe='/')}"

    def pid(self) -> int:
        """Find the process of its postmaster."""
        return int((self.data / "db" / "postmaster.pid").read_text().splitlines()[0])

    def admin_conninfo(self, database: str = "postgres") -> str:
        """Return what libpq connects with as superuser."""
        return f"host={self.data} dbname={database} user=postgres"

    def remove(self) -> None:
        """Stop it; its folder goes with the installation's."""
        self._run("pg_ctl", "-D", str(self.data / "db"), "-m", "immediate", "-w", "stop", check=False)

    def _options(self) -> str:
        return f"-h '' -k {self.data} -c max_connections=200"

    def _run(self, program: str, *arguments: str, check: bool = True) -> bool:
        who: dict[str, Any] = {"user": self._user.uid, "group": self._user.gid, "extra_groups": []} if self._user else {}
        command = [str(self._bin / program), *arguments]
        quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.run(command, cwd="/", check=check, start_new_session=True, **quiet, **who).returncode == 0


class Installation:
    """Processes on one data folder.

    Args:
        folder: the data folder. webs, workers: how many of each. own_server: on the machine's own PostgreSQL, not the embedded one.

    Attributes:
        bases: addresses of the web services. processes: those that should run, by name (`web 1`, `worker 1`).
    """

    def __init__(self, folder: Path, webs: int = 1, workers: int = 1, own_server: bool = False) -> None:
        self.folder = folder
        self.ports = [_free_port() for _ in range(webs)]
        self.bases = [f"http://127.0.0.1:{port}" for port in self.ports]
        self.workers = [f"worker {i + 1}" for i in range(workers)]
        self.webs = [f"web {i + 1}" for i in range(webs)]
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.own = OwnPostgres(folder) if own_server else None
        self.database: Server = self.own or self._embedded()

    def _embedded(self) -> EmbeddedPostgres:
        return EmbeddedPostgres(self.folder / "postgres", server_user=get_settings().server_user)

    def add_people(self, people: dict[str, str]) -> dict[str, str]:
        """Make the tables and people in them, `address: role`; their tokens by address."""
        arguments = [sys.executable, "-c", _PREPARE, json.dumps([people, PASSWORD])]
        done = subprocess.run(arguments, cwd=ROOT, env=self._env(), capture_output=True, text=True, timeout=4 * STARTED_S, check=False)
        if done.returncode:
            raise RuntimeError(f"the installation could not be made:\n{done.stderr[-3000:]}")
        self.database = self.own or self._embedded()  # where the embedded one is, is known now
        tokens: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
        return tokens

    def start(self, name: str) -> None:
        """Start a web or a worker; it is not waited for."""
        arguments = ["worker"] if name in self.workers else ["serve", "--port", str(self.ports[self.webs.index(name)])]
        with (self.folder / f"{name}.log").open("ab") as out:
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", "app.cli", *arguments], cwd=ROOT, env=self._env(), stdout=out, stderr=out, start_new_session=True
            )

    def run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command of `betaloop`."""
        command = [sys.executable, "-m", "app.cli", *arguments]
        return subprocess.run(command, cwd=ROOT, env=self._env(), capture_output=True, text=True, timeout=2 * STARTED_S, check=False)

    def wait_until(self, what: str, condition: Callable[[], Any], seconds: float, every_s: float = 0.05) -> float:
        """Wait for a condition; return the seconds.

        Raises:
            TooLate: it did not within `seconds`; names `what`.
        """
        begun = time.monotonic()
        while not condition():
            if time.monotonic() - begun > seconds:
                raise TooLate(f"waited {seconds:.0f} s in vain for: {what}\n{self.said()}")
            time.sleep(every_s)
        return time.monotonic() - begun

    def is_ready(self, web: str) -> bool:
        """Decide whether a web answers, with its database at the schema of this version."""
        try:
            return httpx.get(f"{self.bases[self.webs.index(web)]}/readyz", timeout=5).status_code == 200
        except httpx.HTTPError:
            return False

    def webs_are_ready(self) -> bool:
        """Decide whether every web is."""
        return all(self.is_ready(web) for web in self.webs)

    def lives_since(self, worker: str, moment: datetime) -> bool:
        """Decide whether the present process of a worker has given a sign of life after a moment."""
        return bool(self.ask("select 1 from worker where pid = %s and seen_at > %s", self.processes[worker].pid, moment))

    def workers_live_since(self, moment: datetime) -> bool:
        """Decide whether every worker's has."""
        return all(self.lives_since(worker, moment) for worker in self.workers)

    def ask(self, query: str, *values: Any) -> list[Any] | None:
        """Fetch the rows of a query as the database's administrator; None while it does not answer."""
        try:
            with psycopg.connect(self.database.admin_conninfo("betaloop"), connect_timeout=5) as connection:
                return connection.execute(query, values).fetchall()  # type: ignore[arg-type]
        except psycopg.OperationalError:
            return None

    def children(self, name: str) -> list[psutil.Process]:
        """List the processes below a web or worker that compute: compute steps, and the forks that read uploads."""
        found = []
        with contextlib.suppress(psutil.Error):
            for process in psutil.Process(self.processes[name].pid).children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    parent = process.parent()
                    if parent is not None and _FORKING in parent.cmdline():
                        found.append(process)
        return found

    def left(self) -> list[str]:
        """Describe the processes that name the data folder; the machine's own PostgreSQL is meant to go on."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                if process.pid == os.getpid() or process.status() == psutil.STATUS_ZOMBIE:
                    continue
                if self.own and process.name().startswith("postgres"):
                    continue
                words = " ".join([*process.cmdline(), process.environ().get("BETALOOP_DATA_DIR", "")])
                if str(self.folder) in words or (self.own is None and str(self._embedded().data) in words):
                    found.append(f"{process.pid}: {words[:150]}")
        return found

    def stop(self) -> None:
        """Stop webs and workers in order. Raises TooLate where one does not end."""
        for process in self.processes.values():
            process.send_signal(signal.SIGTERM)
        for name, process in self.processes.items():
            self.wait_until(f"the end of {name} after SIGTERM", lambda process=process: process.poll() is not None, STOPPED_S)
        self.processes.clear()

    def said(self) -> str:
        """Return the ends of the logs of webs and workers."""
        logs = sorted(self.folder.glob("*.log"))
        return "\n".join(f"--- {log.name}\n" + "\n".join(log.read_text(errors="replace").splitlines()[-15:]) for log in logs)

    def _env(self) -> dict[str, str]:
        env = {k: v for k, v in os.environ.items() if not k.startswith("BETALOOP_") or k in PASSED_ON}
        env |= {"BETALOOP_DATA_DIR": str(self.folder), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        if self.own:
            env |= {"BETALOOP_DATABASE_URL": self.own.url("betaloop_service"), "BETALOOP_OWNER_URL": self.own.url("betaloop_owner")}
        return env


@contextmanager
def installation(webs: int = 1, workers: int = 1, own_server: bool = False, keep: bool = False) -> Iterator[Installation]:
    """Make an installation in a new folder; at the end its processes are killed, and the folder removed unless it is kept."""
    folder = Path(tempfile.mkdtemp(prefix="betaloop-", dir="/tmp"))
    folder.chmod(0o711)  # PostgreSQL runs as a user of its own where root starts it
    one = Installation(folder, webs, workers, own_server)
    try:
        yield one
    finally:
        for process in one.processes.values():
            process.kill()
            process.wait()
        if keep:
            print(f"kept: {folder}")
        else:
            one.database.remove()
            shutil.rmtree(folder, ignore_errors=True)


def times_slower(load: float, own: float) -> float:
    """Compute how many times as long an answer may take as on a machine with nothing else to do, where it is exactly 1.

    Args:
        load: processes that wait for a processor or have one, on average (`os.getloadavg`).
        own: of these, what the measurement makes itself on a machine with nothing else to do.
    """
    return max(1.0, load / max(own, os.cpu_count() or 1))


def utc() -> datetime:
    """Return the present."""
    return datetime.now(UTC)


def _free_port() -> int:
    for port in random.SystemRandom().sample(range(20_000, 32_000), 50):  # none of these is given to an outgoing connection
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise RuntimeError("no free port was found")
