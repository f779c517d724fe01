"""The record of one job while it runs: every change of job, steps and events goes through here.

Each change locks the job's row first, so that a cancel is seen by the very next change. Events get their numbers in the order in which
they become visible: a reader that has seen event 7 never misses an event 6.
"""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy import func, select
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.platform import files
from app.platform.bucket import StoreAway
from app.platform.database import KEPT_TOGETHER, now, set_actor, transaction
from app.platform.jobs import repository
from app.platform.jobs.children.supervisor import ChildMessages
from app.platform.jobs.context import JobCancelled, StepOutcome
from app.tables.jobs import Job, JobStatus, JobStep

log = logging.getLogger(__name__)

Value = TypeVar("Value")
_RETRY_S = (0.2, 5.0)
_CHECK_S = 0.2
WAITS_FOR_FILES = "waits for the store of files"
MOST_UNFINISHED = 0.99
"""Share that a step or a job shows at most before it has ended: its computation may be done, its results are not stored yet."""


_MOST_ACTOR = 254
"""Length of an actor's name in the audit trail."""


def acting_for(person: str) -> str:
    """Name a worker in the audit trail, with the person whose job it runs. That person wrote none of the rows."""
    return f"worker for {person}"[:_MOST_ACTOR]


_MOST_SENDINGS = 3


class _FilesFirst(Exception):
    """Files of a transaction are not in the bucket yet: it is rolled back."""


@dataclass(frozen=True)
class Ledger:
    """Writes about one job, in the name of the worker that runs it, which also names the person who submitted it.

    Args:
        check: raises when this worker must leave the job alone.
    """

    job_id: str
    created_by: str
    worker: str
    check: Callable[[], None]

    def open(self) -> bool:
        """Mark the job as running; False when it has ended already, so that there is nothing to do."""

        def write() -> bool:
            with self._locked(live_only=False) as (db, job):
                if JobStatus(job.status).ended:
                    return False
                if job.status == JobStatus.QUEUED:
                    job.status = JobStatus.RUNNING
                    job.started_at = job.started_at or now()
                    repository.add_event(db, job.id, "status", {"status": job.status})
                job.updated_at = now()
                return True

        return self._persist(write)

    def declare(self, key: str, title: str, weight: float) -> None:
        """Make a step's row unless it is there."""

        def write() -> None:
            with self._locked() as (db, job):
                position = select(func.coalesce(func.max(JobStep.position), -1) + 1).where(JobStep.job_id == job.id).scalar_subquery()
                values = {"job_id": job.id, "key": key, "title": title, "weight": weight, "position": position}
                db.execute(insert(JobStep).values(values).on_conflict_do_nothing(index_elements=["job_id", "key"]))

        self._persist(write)

    def outcome(self, key: str) -> StepOutcome | None:
        """Return the outcome of a step that has ended, else None. Only this record shows what a job has done before a crash."""

        def read() -> StepOutcome | None:
            with self._locked() as (db, job):
                return _outcome(repository.step(db, job.id, key))

        return self._persist(read)

    def begin(self, key: str) -> StepOutcome | None:
        """Start a step, unless it has ended: then its outcome is returned."""

        def write() -> StepOutcome | None:
            with self._locked() as (db, job):
                step = repository.step(db, job.id, key)
                if (known := _outcome(step)) is not None:
                    return known
                step.status, step.message, step.progress = JobStatus.RUNNING, "", 0.0
                step.attempts += 1
                step.worker, step.started_at, step.finished_at = self.worker, now(), None
                self._step_event(db, job, step)
                return None

        return self._persist(write)

    def record(self, key: str, messages: ChildMessages) -> None:
        """Record what a step's process reported."""

        def write() -> None:
            with self._locked() as (db, job):
                step = repository.step(db, job.id, key)
                if messages.progress is not None:
                    step.progress = min(messages.progress, MOST_UNFINISHED)
                if messages.message is not None:
                    step.message = messages.message
                for text in messages.logs or ():
                    repository.add_event(db, job.id, "log", {"text": text}, key)
                if messages.points:
                    repository.add_event(db, job.id, "points", {"points": messages.points}, key)
                if messages.progress is not None or messages.message is not None:
                    self._progress_event(db, job, step)

        self._persist(write)

    def commit_step(self, key: str, fn: Callable[[Session], dict[str, Any]]) -> dict[str, Any]:
        """Run `fn(db)` and mark the step as succeeded with its result, in one transaction; a step that has its result gives that.

        The files that `fn` stores reach the bucket between two runs of it: while they travel, there is no transaction.
        """
        unsent = files.Unsent()

        def write() -> dict[str, Any]:
            for _ in range(_MOST_SENDINGS):
                unsent.send()
                with suppress(_FilesFirst):
                    return attempt(unsent)
            return attempt(None)  # its files are others each time

        def attempt(unsent: files.Unsent | None) -> dict[str, Any]:
            with self._locked() as (db, job):
                if unsent is not None:
                    files.send_later(db, unsent)
                step = repository.step(db, job.id, key)
                if step.status == JobStatus.SUCCEEDED and step.result is not None:
                    return step.result
                step.result = fn(db)
                if unsent is not None and unsent.waiting:
                    raise _FilesFirst
                step.status, step.progress, step.message, step.finished_at = JobStatus.SUCCEEDED, 1.0, "", now()
                self._step_event(db, job, step)
                return step.result

        return persist(write, self.check, lambda: self.tell(key, WAITS_FOR_FILES))

    def tell(self, key: str, message: str) -> None:
        """Say what a step does now."""
        self.record(key, ChildMessages(message=message))

    def fail_step(self, key: str, message: str, trace: str) -> None:
        """Mark a step as failed; the traceback goes to the job's log."""

        def write() -> None:
            with self._locked() as (db, job):
                step = repository.step(db, job.id, key)
                step.status, step.message, step.finished_at = JobStatus.FAILED, message, now()
                if trace:
                    repository.add_event(db, job.id, "log", {"text": trace}, key)
                self._step_event(db, job, step)

        self._persist(write)

    def close(self, status: JobStatus, result: dict[str, Any] | None = None, error: str | None = None, trace: str = "") -> None:
        """End the job; steps that did not end are cancelled."""

        def write() -> None:
            with self._locked(live_only=False) as (db, job):
                if trace:
                    repository.add_event(db, job.id, "log", {"text": trace})
                repository.end_job(db, job, status, result=result, error=error)

        self._persist(write)

    @contextmanager
    def _locked(self, live_only: bool = True) -> Iterator[tuple[Session, Job]]:
        with transaction(acting_for(self.created_by)) as db:
            set_actor(db, acting_for(self.created_by), request_id=self.job_id)
            db.info[KEPT_TOGETHER] = True
            job = repository.locked(db, self.job_id)
            if live_only and (JobStatus(job.status).ended or job.cancel_requested_at is not None):
                raise JobCancelled
            yield db, job

    def _persist(self, write: Callable[[], Value]) -> Value:
        return persist(write, self.check)

    def _step_event(self, db: Session, job: Job, step: JobStep) -> None:
        data = {"status": step.status, "title": step.title, "message": step.message, "attempt": step.attempts}
        repository.add_event(db, job.id, "step", data, step.key)
        self._progress_event(db, job, step)

    def _progress_event(self, db: Session, job: Job, step: JobStep) -> None:
        db.flush()
        # never backwards: a step that is resumed from its checkpoint starts to report from there
        mean = select(func.sum(JobStep.weight * JobStep.progress) / func.sum(JobStep.weight)).where(JobStep.job_id == job.id)
        job.progress = max(job.progress, min(MOST_UNFINISHED, db.scalar(mean) or 0.0))
        job.updated_at = now()
        job.message = f"{step.title}: {step.message}" if step.message else step.title
        left = job.seconds_left(job.updated_at)
        data = {"progress": step.progress, "job_progress": job.progress, "seconds_left": left, "message": step.message}
        repository.add_event(db, job.id, "progress", data, step.key)


def _outcome(step: JobStep) -> StepOutcome | None:
    if step.status == JobStatus.SUCCEEDED:
        return {"ok": True, "result": step.result}
    if step.status == JobStatus.FAILED:
        return {"ok": False, "message": step.message}
    return None


def persist(action: Callable[[], Value], check: Callable[[], None], files_away: Callable[[], None] = lambda: None) -> Value:
    """Do something with the database or the store of files. While one of them is away, wait for it: its restart fails no job.

    Args:
        action: a whole transaction, which may be repeated.
        check: called before every attempt; raises to give up.
        files_away: called when the store of files is away.
    """
    pauses = longer_pauses()
    while True:
        check()
        try:
            return action()
        except StoreAway:
            files_away()
            pause(next(pauses), check)
        except DBAPIError as error:
            if not _worth_repeating(error):
                raise
            log.warning("the database is away, trying again soon (%s)", type(error.orig).__name__)
            pause(next(pauses), check)


def longer_pauses() -> Iterator[float]:
    """Yield the seconds before each further try: ever more, up to a limit, and apart from those of other waiters."""
    seconds, longest = _RETRY_S
    while True:
        yield seconds * random.uniform(0.5, 1.0)  # noqa: S311 - apart from each other, not secret
        seconds = min(2 * seconds, longest)


def pause(seconds: float, check: Callable[[], None]) -> None:
    """Wait, and look meanwhile whether to give up: `check` raises."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        time.sleep(min(left, _CHECK_S))
        check()


def _worth_repeating(error: DBAPIError) -> bool:
    """Decide if a retry may succeed: the connection broke or the database restarts (class 08, 57P), or transactions conflict (class 40).
    Also if the database takes no writes for now: read-only before a standby is promoted (25006), disk full (53100).
    """
    state = getattr(error.orig, "sqlstate", None)
    waits = state in {"25006", "53100"}
    return error.connection_invalidated or state is None or waits or state[:2] in {"08", "40"} or state[:3] == "57P"
