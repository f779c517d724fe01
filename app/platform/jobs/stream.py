"""Server-sent events of one job."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

from fastapi.concurrency import run_in_threadpool
from sqlalchemy.orm import Session

from app.platform.database import new_session, now
from app.platform.jobs import repository
from app.platform.jobs.service import describe_event
from app.platform.jobs.titles import plain_words, reason, state_in_words
from app.platform.numbers import time_left
from app.tables.jobs import Job, JobEvent, JobStatus

POLL_S = 0.5
KEEP_ALIVE_S = 15.0
ASK_AGAIN_S = 10.0
_BATCH = 500


async def job_events(
    job_id: str, last_event_id: str | None = None, still: Callable[[Session], bool] = lambda _: True
) -> AsyncIterator[str]:
    """Yield the events of a job as the lines of a `text/event-stream`, until it ends.

    First comes an event `job` without an id: the state of the job and its steps. Then every event after `last_event_id` (the header
    Last-Event-ID; anything but a number counts as none) under its kind: `status`, `step`, `progress`, `points`, `log`, `cancel`. Last comes
    `end` with the final state; the browser must then close its EventSource, which would connect again otherwise.

    Args:
        still: asked every ASK_AGAIN_S if the listener still may listen; if not, the stream stops without an `end`.

    Raises:
        NotFound: there is no such job.
    """
    last_id = int(last_event_id) if last_event_id and last_event_id.isdecimal() else 0
    state, _ = await run_in_threadpool(_read, job_id, None)
    yield _message("job", state)
    spoken = asked = time.monotonic()
    while True:
        if time.monotonic() - asked >= ASK_AGAIN_S:
            if not await run_in_threadpool(_ask, still):
                return
            asked = time.monotonic()
        state, events = await run_in_threadpool(_read, job_id, last_id)
        for event in events:
            last_id = event["id"]
            yield _message(event["kind"], event, last_id)
            spoken = time.monotonic()
        if len(events) == _BATCH:
            continue
        if JobStatus(state["status"]).ended:
            yield _message("end", state)
            return
        if time.monotonic() - spoken >= KEEP_ALIVE_S:
            yield ": keep-alive\n\n"
            spoken = time.monotonic()
        await asyncio.sleep(POLL_S)


def describe(job: Job) -> dict[str, Any]:
    """Describe the state of a job with its steps, as the event stream and the terminal show it."""
    return {
        "id": job.id,
        "kind": job.kind,
        "status": str(job.status),
        "progress": job.progress,
        "time_left": time_left(job.seconds_left(now())),
        "message": state_in_words(job),
        "error": job.error,
        "result": job.result,
        "steps": [
            {
                "key": s.key,
                "title": s.title,
                "status": str(s.status),
                "progress": s.progress,
                "message": state_in_words(s),
                "weight": s.weight,
            }
            for s in job.steps
        ],
    }


def _ask(still: Callable[[Session], bool]) -> bool:
    with new_session() as db:
        return still(db)


def _read(job_id: str, last_id: int | None) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    with new_session() as db:
        # the state before the events: once it says that the job has ended, the events that follow are the last
        state = describe(repository.get(db, job_id))
        events = [] if last_id is None else repository.events_after(db, job_id, last_id, _BATCH)
        return state, [shown(event) for event in events]


def shown(event: JobEvent) -> dict[str, Any]:
    """Describe an event as pages show it: without names of methods, and with the remaining time in words."""
    described = describe_event(event)
    data = dict(described["data"])
    if "message" in data:
        data["message"] = (reason if data.get("status") == JobStatus.FAILED else plain_words)(data["message"])
    if "seconds_left" in data:
        data["time_left"] = time_left(data["seconds_left"])
    return described | {"data": data}


def _message(kind: str, data: dict[str, Any], event_id: int | None = None) -> str:
    head = f"id: {event_id}\n" if event_id is not None else ""
    return f"{head}event: {kind}\ndata: {json.dumps(data)}\n\n"
