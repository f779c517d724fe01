"""`betaloop demo`: everything on one machine, with a small synthetic study that enters through the public upload path.

Started again, it finds its study and serves it within seconds; interrupted, it goes on: every simulated session has fixed numbers and the
day on which the demo was begun is kept, so that what was uploaded before is recognised by its bytes.
"""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import httpx2 as httpx
import psutil
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from app.accounts import repository as accounts_repository
from app.accounts import service as accounts
from app.accounts.models import Role
from app.platform.database import now, transaction
from app.platform.errors import BetaloopError, Conflict
from app.platform.migrate import migrate
from app.platform.start import require_data_folder, require_free
from app.platform.web.numbers import time_left
from app.settings import get_settings, private_folder, written_once
from app.simulation.demo_study import DemoVisit, demo_visits, participant_body
from app.simulation.keeper import ENDED_BY_ITSELF, ENDING, become_keeper, stop

ACCOUNTS = {"admin@demo.example": Role.ADMIN, "clinician@demo.example": Role.CLINICIAN, "engineer@demo.example": Role.ENGINEER}
PARTICIPANTS = ("P1", "P2", "P3", "P4")
START_TIMEOUT_S = 180.0
_POLL_S = 0.5
_LINE_S = 15.0

console = Console()


class DemoFailed(BetaloopError):
    """The demo cannot go on."""


def run_demo(host: str, port: int) -> None:
    """Start the database, the web service and a worker, load the study, run the first pipelines, and serve until Ctrl-C."""
    settings = get_settings()
    os.environ["BETALOOP_DATA_DIR"] = str(settings.data_dir.resolve())
    url = f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}"  # noqa: S104
    require_free(host, port)
    require_data_folder()
    started = time.monotonic()
    with _only_demo(settings.data_dir, url):
        with console.status("Starting the database …"):
            migrate()
            password = _accounts(settings.data_dir)
        with _children(settings.data_dir / "log", host, port) as children:
            with console.status("Starting the web service and a worker …"):
                _wait_until_up(url, host, port, children)
            say_welcome(url, time.monotonic() - started, password)
            _load_and_rank(url, settings.data_dir / "demo.json", children)
            _say("\n  Ready. Ctrl-C stops the demo and keeps its data; `make demo` starts it again.")
            become_keeper((child.pid for child in children), settings.data_dir / "log")


@contextmanager
def _only_demo(folder: Path, url: str) -> Iterator[None]:
    """Hold the data folder for this demo, as its keeper too. Raises Conflict where another one runs in it."""
    with (folder / "demo.lock").open("a+") as lock:
        os.set_inheritable(lock.fileno(), True)  # the keeper is this process with another program
        lock.seek(0)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            address = lock.read() or "an address that it has not printed yet"
            raise Conflict(
                f"A demo of the data folder {folder} runs already, at {address}.", "Use it, or name another folder in BETALOOP_DATA_DIR."
            ) from None
        lock.truncate()
        lock.write(url)
        lock.flush()
        yield


def _say(line: str) -> None:
    """A line for the terminal or a log; never wrapped, so that an address or a password stays beside its label."""
    console.print(line, soft_wrap=True, highlight=False)


def say_welcome(url: str, seconds: float, password: str) -> None:
    """Print address, accounts and password, each on a line of its own."""
    _say(f"\n  [bold]betaloop is up[/bold] after {seconds:.0f} s")
    _say(f"  address:  [bold underline]{url}[/]")
    _say("  sign in:  [bold]clinician@demo.example[/], engineer@demo.example or admin@demo.example")
    _say(f"  password: [bold]{password}[/]")
    _say("  The four participants are synthetic: simulated, and not fitted to patients.\n")


def _accounts(data_dir: Path) -> str:
    """The demo's users, all with one random password that is kept in the data folder."""
    password = written_once(data_dir / "secrets" / "demo-password", lambda: f"beta-{secrets.token_hex(4)}")
    with transaction("demo") as db:
        for email, role in ACCOUNTS.items():
            if accounts_repository.user_by_email(db, email) is None:
                accounts.add_user(db, email, role, password)
    return password


def _token() -> str:
    with transaction("demo") as db:
        return accounts.create_token(db, "admin@demo.example", f"demo loader {secrets.token_hex(3)}")


@contextmanager
def _children(logs: Path, host: str, port: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """The web service and the worker as child processes with log files; both are stopped at the end."""
    private_folder(logs)
    commands = {"web": ["serve", "--host", host, "--port", str(port)], "worker": ["worker"]}
    children: list[subprocess.Popen[bytes]] = []
    previous = [(number, signal.signal(number, _interrupt)) for number in ENDING]
    try:
        for name, arguments in commands.items():
            with (logs / f"{name}.log").open("ab") as log:
                # a session of its own: Ctrl-C reaches this process alone, which then stops the others in order
                command = [sys.executable, "-m", "app.cli", *arguments]
                children.append(subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True))
        yield children
    except KeyboardInterrupt:
        _say("\n  Stopping …")
    finally:
        impatient = [(number, signal.signal(number, signal.SIG_IGN)) for number in ENDING]
        stop(children)
        for number, handler in (*impatient, *previous):
            signal.signal(number, handler)


_interrupted = threading.Event()


def _interrupt(_number: int, _frame: Any) -> None:
    """End the demo. The exception is lost where Python calls this within a destructor, so `_check` looks at the flag too."""
    _interrupted.set()
    raise KeyboardInterrupt


def _wait_until_up(url: str, host: str, port: int, children: list[subprocess.Popen[bytes]]) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        if children[0].poll() is not None:
            require_free(host, port)  # which another program may have taken meanwhile
        _check(children)
        try:
            # another betaloop may answer at this address, until our own service finds that it cannot listen there
            if httpx.get(f"{url}/healthz", timeout=2).status_code == 200 and _listens(children[0], port):
                return
        except httpx.TransportError:
            pass
        time.sleep(0.2)
    raise DemoFailed(f"The web service did not answer within {START_TIMEOUT_S:.0f} s.", _log_hint())


def _listens(child: subprocess.Popen[bytes], port: int) -> bool:
    try:
        connections = psutil.Process(child.pid).net_connections("tcp")
    except psutil.NoSuchProcess:
        return False
    return any(c.status == psutil.CONN_LISTEN and c.laddr.port == port for c in connections)


def _check(children: list[subprocess.Popen[bytes]]) -> None:
    if _interrupted.is_set():
        raise KeyboardInterrupt
    if any(child.poll() is not None for child in children):
        raise DemoFailed(ENDED_BY_ITSELF, _log_hint())


def _log_hint() -> str:
    return f"See the files in {get_settings().data_dir / 'log'}."


def _load_and_rank(url: str, state_path: Path, children: list[subprocess.Popen[bytes]]) -> None:
    state: dict[str, Any] = (
        json.loads(state_path.read_text()) if state_path.exists() else {"begun": now().date().isoformat(), "loaded": [], "jobs": {}}
    )
    if set(state["loaded"]) == set(PARTICIPANTS) and set(state["jobs"]) == set(PARTICIPANTS):
        return
    columns = (TextColumn("  {task.description:<42}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    _save(state_path, state)
    with httpx.Client(base_url=f"{url}/api/v1", headers={"Authorization": f"Bearer {_token()}"}, timeout=120) as client:
        loader = _Loader(client, state, state_path)
        with Progress(*columns, console=console) as bars:
            for code in PARTICIPANTS:
                if code not in state["loaded"]:
                    loader.load(code, bars)
        for i, code in enumerate(PARTICIPANTS):
            if code not in state["jobs"]:
                loader.submit(code)
            if i == 0:  # the first ranking has the machine to itself; the others follow in the background
                _follow(client, state["jobs"][code], children)
    _say(f"  Ranked policies of {PARTICIPANTS[0]}: [underline]{url}/participants/{PARTICIPANTS[0]}/ranking[/]")
    _say(f"  The other participants are ranked in the background: [underline]{url}/participants/{PARTICIPANTS[1]}/jobs[/]")


@dataclass
class _Loader:
    """Sends the simulated study through the REST interface, as any clinic's uploader would."""

    client: httpx.Client
    state: dict[str, Any]
    path: Path

    def load(self, code: str, bars: Progress) -> None:
        """One participant: enrol, add visits, upload every session's file, enter the QoCs."""
        self._post("/participants", participant_body(code), may_exist=True)
        visits = demo_visits(code, date.fromisoformat(self.state["begun"]))
        total = sum(len(v.sessions) for v in visits) or 1
        bar = bars.add_task(f"{code}: simulate and upload sessions", total=total)
        for visit in visits:
            self._post(f"/participants/{code}/visits", {"number": visit.number, "date": visit.date.isoformat()}, may_exist=True)
            self._upload(code, visit, bars, bar)
        self.state["loaded"].append(code)
        _save(self.path, self.state)

    def submit(self, code: str) -> None:
        """Ask for the between-visit pipeline."""
        asked = {"kind": "pipeline", "preset": "quick"}
        self.state["jobs"][code] = self._post(f"/participants/{code}/jobs", asked)["id"]
        _save(self.path, self.state)

    def _upload(self, code: str, visit: DemoVisit, bars: Progress, bar: TaskID) -> None:
        for session in visit.sessions:
            name, content = session.file()
            fields = {"participant": code, "visit": str(visit.number), "controller": session.controller}
            if session.started_at is not None:
                fields["started_at"] = session.started_at.isoformat()
            answer = self.client.post("/uploads", data=fields, files={"file": (name, content)})
            stored = self._checked(answer)["sessions"][0]["id"]
            self._checked(
                self.client.put(f"/sessions/{stored}/qoc", json=session.qoc() | {"sure": ["grasp_hz", "rating", "tremor_percent"]})
            )
            if (conditions := session.conditions()) is not None:
                self._checked(self.client.put(f"/sessions/{stored}/conditions", json=conditions))
            bars.advance(bar)

    def _post(self, path: str, body: dict[str, Any], may_exist: bool = False) -> dict[str, Any]:
        answer = self.client.post(path, json=body)
        if may_exist and answer.status_code == 409:
            return {}
        return self._checked(answer)

    def _checked(self, answer: httpx.Response) -> dict[str, Any]:
        if answer.is_error:
            raise DemoFailed(f"{answer.request.method} {answer.request.url.path} was answered {answer.status_code}: {answer.text}")
        body: dict[str, Any] = answer.json()
        return body


def _save(path: Path, state: dict[str, Any]) -> None:
    draft = path.with_suffix(".part")
    draft.write_text(json.dumps(state))
    draft.replace(path)


def _follow(client: httpx.Client, job_id: str, children: list[subprocess.Popen[bytes]]) -> None:
    """Say how far the first ranking is until it is there: bars in a terminal, lines from time to time in a log file."""
    job: dict[str, Any] = {}

    def jobs() -> Iterator[dict[str, Any]]:
        while job.get("status") not in {"succeeded", "failed", "cancelled"}:
            _check(children)
            job.update(client.get(f"/jobs/{job_id}").json())
            yield job
            time.sleep(_POLL_S)

    (_draw if console.is_terminal else _print)(jobs())
    if job["status"] != "succeeded":
        _say(f"  [bold red]The pipeline {job['status']}:[/] {job.get('error') or ''} See the Jobs page.")


def _draw(jobs: Iterator[dict[str, Any]]) -> None:
    columns = (
        TextColumn("  {task.description:<42}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=console) as bars:
        whole = bars.add_task("First ranking", total=1.0, left="")
        known: dict[str, TaskID] = {}
        for job in jobs:
            bars.update(whole, completed=job["progress"], left=_left(job))
            for step in job["steps"]:
                if step["key"] not in known:
                    known[step["key"]] = bars.add_task(f"· {step['title']}", total=1.0, left="")
                bars.update(known[step["key"]], completed=step["progress"])


def _print(jobs: Iterator[dict[str, Any]]) -> None:
    done: set[str] = set()
    due = 0.0
    for job in jobs:
        for step in job["steps"]:
            if step["status"] == "succeeded" and step["key"] not in done:
                done.add(step["key"])
                _say(f"  {step['title']}: done")
        if time.monotonic() >= due and job["status"] in {"queued", "running"}:
            due = time.monotonic() + _LINE_S
            _say(f"  First ranking: {100 * job['progress']:.0f} %, {_left(job)}")


def _left(job: dict[str, Any]) -> str:
    if job["status"] == "queued":
        return "waits for the worker"
    if job["status"] != "running":
        return ""
    return time_left(job["seconds_left"])
