"""A job on the terminal."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from app.platform.database import new_session
from app.platform.jobs import repository
from app.platform.jobs.stream import describe
from app.tables.jobs import JobStatus

POLL_S = 0.5


@dataclass(frozen=True)
class StepView:
    """A step as it stood at one look."""

    key: str
    title: str
    status: JobStatus
    progress: float
    message: str


@dataclass(frozen=True)
class JobView:
    """A job as it stood at one look."""

    id: str
    kind: str
    status: JobStatus
    progress: float
    message: str
    error: str | None
    result: dict[str, Any] | None
    steps: tuple[StepView, ...]


def look(job_id: str) -> JobView:
    """Read the current state of the job. Raises NotFound if there is none."""
    with new_session() as db:
        state = describe(repository.get(db, job_id))
    steps = tuple(StepView(s["key"], s["title"], JobStatus(s["status"]), s["progress"], s["message"]) for s in state["steps"])
    return JobView(
        state["id"], state["kind"], JobStatus(state["status"]), state["progress"], state["message"], state["error"], state["result"], steps
    )


def watch(job_id: str, poll_s: float = POLL_S) -> Iterator[JobView]:
    """Yield the state of the job whenever it changed; the last one has ended.

    Raises:
        NotFound: there is none.
    """
    last: JobView | None = None
    while True:
        view = look(job_id)
        if view != last:
            yield view
        if view.status.ended:
            return
        last = view
        time.sleep(poll_s)


def show_progress(job_id: str, console: Console | None = None) -> JobView:
    """Draw a bar for every step until the job ends; returns how it ended."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console) as progress:
        bars: dict[str, TaskID] = {}
        for view in watch(job_id):
            for step in view.steps:
                if step.key not in bars:
                    bars[step.key] = progress.add_task(step.title, total=1.0, start=False, note="")
                if step.status != JobStatus.QUEUED:
                    progress.start_task(bars[step.key])
                progress.update(bars[step.key], completed=step.progress, note=step.message)
                if step.status.ended:
                    progress.stop_task(bars[step.key])
    return view


def follow(job_id: str, wait: bool, as_json: bool) -> None:
    """Finish a command that starts a job: show its progress if `wait`, and print its status.

    Raises:
        typer.Exit: 1 where it failed or was cancelled.
    """
    status = show_progress(job_id, Console(stderr=True)).status if wait else look(job_id).status
    print(json.dumps({"id": job_id, "status": status.value}) if as_json else f"Job {job_id}: {status}.")  # noqa: T201
    if status in {JobStatus.FAILED, JobStatus.CANCELLED}:
        raise typer.Exit(1)
