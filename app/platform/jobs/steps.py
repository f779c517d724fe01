"""How a worker runs one job: the orchestration around, the steps inside."""

from __future__ import annotations

import json
import logging
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.platform.database import new_session
from app.platform.errors import BetaloopError
from app.platform.jobs import engine, registry, repository
from app.platform.jobs.children.slots import Slots
from app.platform.jobs.children.supervisor import Call, Nursery
from app.platform.jobs.context import JobContext, Outcome
from app.platform.jobs.errors import JobCancelled, WorkerStopping
from app.platform.jobs.ledger import Ledger, persist
from app.platform.jobs.models import Job, JobStatus
from app.settings import get_settings

log = logging.getLogger(__name__)


@dataclass
class Flags:
    """What the worker tells the threads of one job."""

    cancelled: threading.Event = field(default_factory=threading.Event)
    abandoned: threading.Event = field(default_factory=threading.Event)

    def check(self) -> None:
        """Raise what was asked for."""
        if self.abandoned.is_set():
            raise WorkerStopping
        if self.cancelled.is_set():
            raise JobCancelled


@dataclass(frozen=True)
class JobSteps:
    """The steps of one job, carried out by this worker."""

    ledger: Ledger
    flags: Flags
    nursery: Nursery
    slots: Slots

    def declare(self, key: str, title: str, weight: float) -> None:
        """Make the step's row unless it is there."""
        self.ledger.declare(key, title, weight)

    def compute(self, key: str, name: str, params: dict[str, Any], skip: Callable[[], bool]) -> Outcome:
        """Run a compute function in a child process, unless `skip()` holds when its turn comes."""
        function = registry.compute_function(name)
        call = Call(function, _as_json(params, f"the params of step {key!r}"), self.workdir(key), get_settings().job_memory_mb)
        with self.slots.hold(self.ledger.job_id, self.flags.check):
            if skip():
                return {"ok": False, "skipped": True}
            if (known := self.ledger.begin(key)) is not None:
                return {"ok": True, "result": known}
            outcome = self.nursery.run(call, lambda heard: self.ledger.hear(key, heard), self.flags.check)
        if outcome["ok"]:
            return {"ok": True, "result": self.ledger.commit_step(key, lambda _: outcome["result"])}
        self.ledger.fail_step(key, outcome["message"], outcome["log"])
        return {"ok": False, "message": outcome["message"]}

    def transact(self, key: str, fn: Callable[[Session], dict[str, Any]]) -> Outcome:
        """Run a function in a database transaction together with its record."""
        if (known := self.ledger.begin(key)) is not None:
            return {"ok": True, "result": known}
        try:
            return {"ok": True, "result": self.ledger.commit_step(key, lambda db: _as_json(fn(db), f"the result of step {key!r}"))}
        except Exception as error:
            message = worded(error)
            self.ledger.fail_step(key, message, _trace(error))
            return {"ok": False, "message": message}

    def say(self, text: str) -> None:
        """Add a line to the job's log."""
        self.ledger.say(text)

    def workdir(self, key: str) -> Path:
        """Folder of a step; the parts of a key are joined so that no step's folder lies within another's."""
        return get_settings().jobs_dir / self.ledger.job_id / key.replace("/", "__")


class JobRunner:
    """Runs the jobs that the engine hands out; one per worker."""

    def __init__(self, worker: str, slots: int) -> None:
        self._worker = worker
        self._slots = Slots(slots)
        self._nursery = Nursery()
        self._running: dict[str, Flags] = {}
        self._changed = threading.Condition()
        self._stopping = False

    def run(self, job_id: str) -> None:
        """Run one job to its end; everything that can go wrong is recorded in its row.

        Raises:
            WorkerStopping: the job is left as it is, for another worker or a later start.
        """
        flags = Flags()
        with self._changed:
            if self._stopping:
                raise WorkerStopping
            self._running[job_id] = flags
        try:
            self._run(job_id, flags)
        finally:
            with self._changed:
                if self._running.get(job_id) is flags:
                    del self._running[job_id]
                self._changed.notify_all()

    def running(self) -> list[str]:
        """Ids of the jobs that run here."""
        with self._changed:
            return list(self._running)

    def cancel(self, job_id: str) -> None:
        """Kill the job's children and end it as cancelled."""
        with self._changed:
            if flags := self._running.get(job_id):
                flags.cancelled.set()

    def abandon(self, job_id: str) -> None:
        """Kill the job's children and forget it: another worker has it."""
        with self._changed:
            if flags := self._running.get(job_id):
                flags.abandoned.set()

    def stop(self, timeout_s: float) -> bool:
        """Abandon everything and wait until the threads have let go; False when they did not in time."""
        with self._changed:
            self._stopping = True
            for flags in self._running.values():
                flags.abandoned.set()
            done = self._changed.wait_for(lambda: not self._running, timeout_s)
        self._nursery.close()
        return done

    def _run(self, job_id: str, flags: Flags) -> None:
        check = _check_abandoned(flags)
        job = persist(lambda: _job(job_id), check)
        ledger = Ledger(job_id, job.created_by, self._worker, check)
        if not ledger.open():
            return
        steps = JobSteps(ledger, flags, self._nursery, self._slots)
        context = JobContext(job_id, job.kind, job.participant_id, job.params, job.created_by, steps, engine.Durability())
        try:
            if job.cancel_requested_at is not None:
                raise JobCancelled
            result = _as_json(registry.kind(job.kind).run(context), f"the result of job kind {job.kind!r}")
            flags.check()
            ledger.close(JobStatus.SUCCEEDED, result=result)
        except JobCancelled:
            ledger.close(JobStatus.CANCELLED)
        except Exception as error:
            expected = isinstance(error, BetaloopError)
            if not expected:
                log.exception("job %s (%s) failed", job_id, job.kind)
            ledger.close(JobStatus.FAILED, error=worded(error), trace="" if expected else _trace(error))


def worded(error: Exception) -> str:
    """One line for the user."""
    if isinstance(error, BetaloopError):
        return str(error)
    text = str(error.orig if isinstance(error, DBAPIError) else error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0]}" if text else type(error).__name__


def _job(job_id: str) -> Job:
    with new_session() as db:
        return repository.get(db, job_id)


def _check_abandoned(flags: Flags) -> Callable[[], None]:
    def check() -> None:
        if flags.abandoned.is_set():
            raise WorkerStopping

    return check


def _as_json(value: dict[str, Any], what: str) -> dict[str, Any]:
    """The value as a replay would see it, so that the first run sees the same."""
    if not isinstance(value, dict):
        raise TypeError(f"{what} must be a dict, not {type(value).__name__}")
    try:
        plain: dict[str, Any] = json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise TypeError(f"{what} must be JSON: {error}") from error
    return plain


def _trace(error: Exception) -> str:
    return "".join(traceback.format_exception(error))
