"""The loader of the demo's study: a process of its own, which sends everything through the REST interface and ends.

Every step can be repeated: what exists is recognised, and finished steps are recorded next to the data. So a loader that was
stopped anywhere goes on when the demo is started again.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, Final

import httpx2 as httpx
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from app.platform.errors import BetaloopError
from app.platform.numbers import time_left

Step = tuple[str, Callable[[], None]]
"""One thing to do, with the name under which it is written down."""
STATE_VERSION: Final = 2
_POLL_S = 0.5
_TIMEOUT_S = 300.0
_LINE_S = 15.0


class LoadFailed(BetaloopError):
    """The demo's study cannot be loaded."""


@dataclass
class State:
    """Progress of the loading, saved after every step, so that a demo that is started again goes on.

    Attributes:
        begun: the day on which the demo was begun, which all visits are dated by. done: names of finished steps. jobs: by name.
    """

    path: Path
    begun: date
    done: set[str] = field(default_factory=set)
    jobs: dict[str, str] = field(default_factory=dict)
    complete: bool = False
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def at(cls, path: Path, today: date) -> State:
        """Read the state of a data folder, or begin one today.

        Raises:
            LoadFailed: a demo that another version has begun.
        """
        if not path.exists():
            state = cls(path, today)
            state.save()
            return state
        stored = json.loads(path.read_text("utf-8"))
        if stored.get("version") != STATE_VERSION:
            raise LoadFailed(
                "The demo in this data folder was begun by another version of betaloop.",
                "Choose another folder (BETALOOP_DATA_DIR), or remove this one with `make clean`.",
            )
        begun = date.fromisoformat(stored["begun"])
        return cls(path, begun, set(stored["done"]), stored["jobs"], stored["complete"])

    def finish(self, step: str) -> None:
        """Write down that a step is done."""
        with self._lock:
            self.done.add(step)
            self._write()

    def started(self, name: str, job_id: str) -> None:
        """Write down a job that was started."""
        with self._lock:
            self.jobs[name] = job_id
            self._write()

    def forget(self, name: str) -> None:
        """Take a job out that did not succeed: another one is started when the demo goes on."""
        with self._lock:
            del self.jobs[name]
            self._write()

    def save(self) -> None:
        """Write the state as it is."""
        with self._lock:
            self._write()

    def _write(self) -> None:
        draft = self.path.with_suffix(".part")
        known = {"version": STATE_VERSION, "begun": self.begun.isoformat(), "done": sorted(self.done), "jobs": self.jobs}
        draft.write_text(json.dumps(known | {"complete": self.complete}), "utf-8")
        draft.replace(self.path)


class Door:
    """The REST interface for one person.

    Args:
        url: of the service. token: of the person.
    """

    def __init__(self, url: str, token: str) -> None:
        self._client = httpx.Client(base_url=f"{url}/api/v1", headers={"Authorization": f"Bearer {token}"}, timeout=_TIMEOUT_S)

    def get(self, path: str) -> Any:
        """Get the resource at a path."""
        return _checked(self._client.get(path))

    def has(self, path: str) -> bool:
        """Ask if there is a resource at a path."""
        answer = self._client.get(path)
        if answer.status_code == 404:
            return False
        _raise(answer)
        return True

    def post(self, path: str, body: dict[str, Any], *, may_exist: bool = False) -> Any:
        """Send an object; where it may be there already, a conflict is no fault and gives an empty answer."""
        answer = self._client.post(path, json=body)
        return {} if may_exist and answer.status_code == 409 else _checked(answer)

    def put(self, path: str, body: dict[str, Any]) -> Any:
        """Put a new version of the resource at a path."""
        return _checked(self._client.put(path, json=body))

    def upload(self, fields: dict[str, str], name: str, content: bytes, *, may_be_unusable: bool = False) -> Any:
        """Send a file as the upload page does. An unreadable file is kept for a person, and gives an empty answer."""
        answer = self._client.post("/uploads", data=fields, files={"file": (name, content)})
        return {} if may_be_unusable and answer.status_code == 422 else _checked(answer)

    def read(self, path: str) -> bytes:
        """Read the bytes at a path."""
        answer = self._client.get(path)
        _raise(answer)
        return answer.content

    def wait(self, job_id: str) -> None:
        """Wait for a job. Raises LoadFailed where it does not succeed."""
        while (job := self.get(f"/jobs/{job_id}"))["status"] not in {"succeeded", "failed", "cancelled"}:
            time.sleep(_POLL_S)
        if job["status"] != "succeeded":
            raise LoadFailed(f"The job {job['kind']} of {job['participant']} {job['status']}: {job.get('error') or 'no reason given'}")


def _raise(answer: httpx.Response) -> None:
    if answer.is_error:
        raise LoadFailed(f"{answer.request.method} {answer.request.url.path} was answered {answer.status_code}: {answer.text}")


def _checked(answer: httpx.Response) -> Any:
    _raise(answer)
    return answer.json()


def run_all(state: State, lines: Sequence[Sequence[Step]], report: Callable[[int, int], None]) -> None:
    """Do the remaining steps of every line, the lines in parallel, each in its order.

    Args:
        report: called with how many steps are done, and how many there are.

    Raises:
        BetaloopError: the error of the first line that failed; the others end after their present step.
    """
    total = sum(len(line) for line in lines)
    failed = threading.Event()

    def walk(line: Sequence[Step]) -> None:
        for name, do in line:
            if failed.is_set():
                return
            if name not in state.done:
                try:
                    do()
                except BaseException:
                    failed.set()
                    raise
                state.finish(name)
            report(len(state.done), total)

    with ThreadPoolExecutor(len(lines)) as pool:
        for walked in [pool.submit(walk, line) for line in lines]:
            walked.result()


def follow(door: Door, job_id: str) -> Iterator[dict[str, Any]]:
    """Yield the state of a job repeatedly, until its end."""
    while True:
        job: dict[str, Any] = door.get(f"/jobs/{job_id}")
        yield job
        if job["status"] in {"succeeded", "failed", "cancelled"}:
            return
        time.sleep(2 * _POLL_S)


def show(console: Console, jobs: Iterator[dict[str, Any]]) -> dict[str, Any]:
    """Say how far the first ranking is until it is there: bars in a terminal, lines from time to time in a log file. Gives the job."""
    job: dict[str, Any] = {}

    def noted() -> Iterator[dict[str, Any]]:
        for one in jobs:
            job.update(one)
            yield one

    (_draw if console.is_terminal else _print)(console, noted())
    return job


def _draw(console: Console, jobs: Iterator[dict[str, Any]]) -> None:
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


def _print(console: Console, jobs: Iterator[dict[str, Any]]) -> None:
    done: set[str] = set()
    due = 0.0
    for job in jobs:
        for step in job["steps"]:
            if step["status"] == "succeeded" and step["key"] not in done:
                done.add(step["key"])
                console.print(f"  {step['title']}: done", soft_wrap=True, highlight=False)
        if time.monotonic() >= due and job["status"] in {"queued", "running"}:
            due = time.monotonic() + _LINE_S
            console.print(f"  First ranking: {100 * job['progress']:.0f} %, {_left(job)}", soft_wrap=True, highlight=False)


def _left(job: dict[str, Any]) -> str:
    if job["status"] == "queued":
        return "waits for the worker"
    if job["status"] != "running":
        return ""
    return time_left(job["seconds_left"])


def main(url: str, state_path: Path) -> None:
    """Load what is missing and start the jobs that train, then end."""
    from app.simulation.demo.content import load

    load(url, state_path)


if __name__ == "__main__":
    try:
        main(sys.argv[1], Path(sys.argv[2]))
    except (BetaloopError, httpx.TransportError) as error:
        sys.exit(f"  {error}")
