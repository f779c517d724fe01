"""Run of one job by a worker: the orchestration around, the steps inside."""

from __future__ import annotations

import json
import logging
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.platform.database import new_session
from app.platform.errors import BetaloopError
from app.platform.jobs import registry, repository, service
from app.platform.jobs.children.child import ChildLimits
from app.platform.jobs.children.forked import ForkedProcesses
from app.platform.jobs.children.limited import Slots
from app.platform.jobs.children.supervisor import ChildProcesses, ComputeCall, take_over
from app.platform.jobs.context import JobCancelled, JobContext, StepOutcome, WorkerStopping
from app.platform.jobs.ledger import WAITS_FOR_FILES, Ledger, longer_pauses, pause, persist
from app.settings import get_settings, private_folder
from app.tables.jobs import Job, JobStatus

log = logging.getLogger(__name__)

KILLED_RETRIES = 1
"""How often a step is tried again, from its checkpoint, when its process was killed from outside."""


@dataclass
class StopRequests:
    """Requests of the worker to the threads of one job: to end as cancelled, or to leave the job to another worker."""

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
    requests: StopRequests
    children: ChildProcesses
    slots: Slots
    urgency: int = 0
    repeated: Sequence[str] = ()
    """Ids of the jobs that this one repeats, the latest first."""

    def declare(self, key: str, title: str, weight: float) -> None:
        """Make the step's row unless it is there."""
        self.ledger.declare(key, title, weight)

    def compute(self, key: str, name: str, params: dict[str, Any], skip: Callable[[], bool]) -> StepOutcome:
        """Run a compute function in a child process, unless `skip()` holds when its turn comes."""
        checked = _as_json(params, f"the params of step {key!r}")
        if (known := self.ledger.outcome(key)) is not None:  # before waiting for a slot: after a crash, most steps have ended
            return known
        settings = get_settings()
        limits = ChildLimits(settings.job_memory_mb, niceness=settings.job_niceness)
        call = ComputeCall(name, registry.compute_reference(name), checked, self.workdir(key), limits, service.code_version())
        if any(take_over(call, _workdir(earlier, key)) for earlier in self.repeated):
            log.info("step %s of job %s has the result of the job that this one repeats", key, self.ledger.job_id)
        pauses = longer_pauses()
        while True:
            with self.slots.hold(self.ledger.job_id, self.requests.check, self.urgency):
                if skip():
                    return {"ok": False, "skipped": True}
                outcome = self._run(key, call)
            if outcome.get("cause") != "away":
                break
            # other steps may do without files: they get the slot
            self.ledger.tell(key, WAITS_FOR_FILES)
            pause(next(pauses), self.requests.check)
        if outcome["ok"]:
            return {"ok": True, "result": self.ledger.commit_step(key, lambda _: outcome["result"])}
        self.ledger.fail_step(key, outcome["message"], outcome.get("log", ""))
        return {"ok": False, "message": outcome["message"]}

    def _run(self, key: str, call: ComputeCall) -> StepOutcome:
        """Run a step's child; one that was killed from outside is tried again."""
        for attempt in range(1 + KILLED_RETRIES):
            if (known := self.ledger.begin(key)) is not None:
                return known
            outcome = self.children.run(call, lambda messages: self.ledger.record(key, messages), self.requests.check)
            if outcome["ok"] or outcome["cause"] != "killed" or attempt == KILLED_RETRIES:
                break
            log.warning("step %s of job %s: %s It is tried once more", key, self.ledger.job_id, outcome["message"])
        return outcome

    def transact(self, key: str, fn: Callable[[Session], dict[str, Any]]) -> StepOutcome:
        """Run a function in a database transaction together with its record."""
        if (known := self.ledger.begin(key)) is not None:
            return known
        try:
            return {"ok": True, "result": self.ledger.commit_step(key, lambda db: _as_json(fn(db), f"the result of step {key!r}"))}
        except Exception as error:
            message = worded(error)
            self.ledger.fail_step(key, message, _trace(error))
            return {"ok": False, "message": message}

    def workdir(self, key: str) -> Path:
        """Return the folder of a step; the parts of a key are joined so that no step's folder is within another's."""
        private_folder(private_folder(get_settings().jobs_dir) / self.ledger.job_id)
        return _workdir(self.ledger.job_id, key)


class JobRunner:
    """Runs the jobs that the engine hands out; one per worker."""

    def __init__(self, worker: str, slots: int) -> None:
        self._worker = worker
        self._slots = Slots(slots)
        self._children = ForkedProcesses(learns=True, niceness=get_settings().job_niceness)
        self._running: dict[str, StopRequests] = {}
        self._changed = threading.Condition()
        self._stopping = False

    def run(self, job_id: str) -> None:
        """Run one job to its end; everything that can go wrong is recorded in its row.

        Raises:
            WorkerStopping: the job is left as it is, for another worker or a later start.
        """
        requests = StopRequests()
        with self._changed:
            if self._stopping or job_id in self._running:
                raise WorkerStopping
            self._running[job_id] = requests
        try:
            self._run(job_id, requests)
        finally:
            with self._changed:
                if self._running.get(job_id) is requests:
                    del self._running[job_id]
                self._changed.notify_all()

    def running(self) -> list[str]:
        """List the ids of the jobs that run here."""
        with self._changed:
            return list(self._running)

    def cancel(self, job_id: str) -> None:
        """Kill the job's children and end it as cancelled."""
        with self._changed:
            if requests := self._running.get(job_id):
                requests.cancelled.set()

    def abandon(self, job_id: str) -> None:
        """Kill the job's children and forget it: another worker has it."""
        with self._changed:
            if requests := self._running.get(job_id):
                requests.abandoned.set()

    def stop(self, timeout_s: float) -> bool:
        """Abandon everything and wait until the threads have let go; False when they did not in time."""
        with self._changed:
            self._stopping = True
            for requests in self._running.values():
                requests.abandoned.set()
            done = self._changed.wait_for(lambda: not self._running, timeout_s)
        self._children.close()
        return done

    def _run(self, job_id: str, requests: StopRequests) -> None:
        check = _check_abandoned(requests)
        job, repeated = persist(lambda: _job(job_id), check)
        ledger = Ledger(job_id, job.created_by, self._worker, check)
        if not ledger.open():
            return
        steps = JobSteps(ledger, requests, self._children, self._slots, job.urgency, repeated)
        context = JobContext(job_id, job.kind, job.participant_id, job.params, job.created_by, steps)
        try:
            if job.cancel_requested_at is not None:
                raise JobCancelled
            service.checked_params(job.kind, job.params)  # a newer version may have asked for it
            result = _as_json(registry.kind(job.kind).run(context), f"the result of job kind {job.kind!r}")
            requests.check()
            ledger.close(JobStatus.SUCCEEDED, result=result)
        except JobCancelled:
            ledger.close(JobStatus.CANCELLED)
        except Exception as error:
            expected = isinstance(error, BetaloopError)
            if not expected:
                log.exception("job %s (%s) failed", job_id, job.kind)
            ledger.close(JobStatus.FAILED, error=worded(error), trace="" if expected else _trace(error))


def _workdir(job_id: str, key: str) -> Path:
    return get_settings().jobs_dir / job_id / key.replace("/", "__")


def worded(error: Exception) -> str:
    """Phrase an error in one line for the user."""
    if isinstance(error, BetaloopError):
        return str(error)
    text = str(error.orig if isinstance(error, DBAPIError) else error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0]}" if text else type(error).__name__


def _job(job_id: str) -> tuple[Job, list[str]]:
    with new_session() as db:
        job = repository.get(db, job_id)
        return job, repository.jobs_before(db, job)


def _check_abandoned(requests: StopRequests) -> Callable[[], None]:
    def check() -> None:
        if requests.abandoned.is_set():
            raise WorkerStopping

    return check


def _as_json(value: dict[str, Any], what: str) -> dict[str, Any]:
    """Convert a value to what a replay would see, so that the first run sees the same."""
    if not isinstance(value, dict):
        raise TypeError(f"{what} must be a dict, not {type(value).__name__}")
    try:
        plain: dict[str, Any] = json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise TypeError(f"{what} must be JSON: {error}") from error
    return plain


def _trace(error: Exception) -> str:
    return "".join(traceback.format_exception(error))
