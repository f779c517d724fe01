"""The worker: takes jobs from the queue, shows that it lives, and looks after the jobs of workers that do not."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import shutil
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import Connection, text
from sqlalchemy.exc import DBAPIError

from app.platform import kept
from app.platform.bucket import prune_copies_beside
from app.platform.database import database_url, get_engine, new_session, set_actor, transaction
from app.platform.jobs import engine, repository, service
from app.platform.jobs.steps import JobRunner
from app.settings import get_settings
from app.tables.jobs import JobStatus

log = logging.getLogger(__name__)

CANCEL_POLL_S = 0.5
IDLE_S = 20.0
KEEP_FINISHED = timedelta(days=14)
"""How long the engine's rows and the working folders of finished jobs are kept."""
_MOST_WORKERS = 1000
_STOP_WAIT_S = 8.0
_ACTOR = "worker"


@dataclass(frozen=True)
class Pace:
    """Intervals of a worker's tasks, seconds; tests run faster."""

    beat_s: float = 5.0
    stale_s: float = 20.0
    housekeeping_s: float = 3600.0


class IdentityLost(RuntimeError):
    """Another process took this worker's name while its connection was gone; it must not go on."""


class Identity:
    """A worker's name, `host-N` with the smallest free N: the same after a restart, and never two live workers at once.

    An advisory lock in the database holds it, which ends with the connection, that is with the process, kill -9 included.
    """

    def __init__(self) -> None:
        self._connection: Connection | None = None
        self.id = ""

    def claim(self) -> str:
        """Take the first free name."""
        host = socket.gethostname()
        for number in range(_MOST_WORKERS):
            if self._lock(f"{host}-{number}"):
                return self.id
        raise RuntimeError(f"there are {_MOST_WORKERS} workers on {host} already")

    def keep(self) -> None:
        """Take the name again if the connection was lost.

        Raises:
            IdentityLost: another worker has it now.
        """
        try:
            if self._connection is not None:
                self._connection.execute(text("select 1"))
                return
        except DBAPIError:
            self.release()
        if not self._lock(self.id):
            raise IdentityLost(f"another worker took the name {self.id} while the database was away")

    def release(self) -> None:
        """Give the name up."""
        if self._connection is not None:
            self._connection.invalidate()  # closes it, and with it the lock, instead of handing it back to the pool
            self._connection.close()
            self._connection = None

    def _lock(self, name: str) -> bool:
        connection = get_engine().connect().execution_options(isolation_level="AUTOCOMMIT")
        if connection.scalar(text("select pg_try_advisory_lock(hashtextextended(:name, 0))"), {"name": f"betaloop worker {name}"}):
            self._connection, self.id = connection, name
            return True
        connection.close()
        return False


class WorkerMonitor:
    """The worker's own thread: signs of life, cancel requests, jobs of dead workers, old rows and folders."""

    def __init__(self, identity: Identity, runner: JobRunner, pace: Pace) -> None:
        self._identity, self._runner, self._pace = identity, runner, pace
        self._host, self._pid = socket.gethostname(), os.getpid()
        self._may_reap_at = 0.0
        self._lost: set[str] = set()
        self._idle_since: float | None = None
        self._next_beat = self._next_housekeeping = 0.0

    def look(self) -> None:
        """Do one round; called every CANCEL_POLL_S.

        Raises:
            IdentityLost: the worker must stop.
        """
        try:
            self._cancel()
            self._return_memory()
            if time.monotonic() >= self._next_beat:
                self._next_beat = time.monotonic() + self._pace.beat_s
                self.beat()
                self._drop_jobs_taken_over()
                self._reap()
                self._end_given_up()
            if time.monotonic() >= self._next_housekeeping:
                self._next_housekeeping = time.monotonic() + self._pace.housekeeping_s
                self.tidy()
                prune_copies_beside()
        except DBAPIError as error:
            log.warning("the database is away: %s", type(error.orig).__name__)

    def beat(self) -> None:
        """Say that we live."""
        self._identity.keep()
        with transaction(_ACTOR) as db:
            silent_s = repository.beat(db, self._identity.id, self._host, self._pid, engine.PROTOCOL, service.code_version())
        if silent_s > self._pace.stale_s:
            # the machine slept: other workers of this machine did too, and need a moment to show that they live
            self._may_reap_at = time.monotonic() + self._pace.stale_s

    def _return_memory(self) -> None:
        """Return to the system what the last jobs have left in memory, once nothing has run for IDLE_S."""
        if self._runner.running():
            self._idle_since = time.monotonic()
        elif self._idle_since is not None and time.monotonic() - self._idle_since > IDLE_S:
            self._idle_since = None
            kept.forget()
            gc.collect()
            if hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
                libc.malloc_trim(0)  # else glibc keeps what is free below what is in use

    def _cancel(self) -> None:
        if running := self._runner.running():
            with new_session() as db:
                for job_id in repository.cancel_requests(db, running):
                    self._runner.cancel(job_id)

    def _drop_jobs_taken_over(self) -> None:
        """Drop jobs that another worker took over, because we were silent for too long."""
        if running := self._runner.running():
            with new_session() as db:
                owners = engine.owners(db)
            for job_id in running:
                if owners.get(job_id, self._identity.id) != self._identity.id:
                    log.warning("job %s was taken over by %s", job_id, owners[job_id])
                    self._runner.abandon(job_id)

    def adopt(self) -> None:
        """Take the jobs of older protocols that no live worker speaks."""
        with transaction(_ACTOR) as db:
            spoken = {worker.protocol for worker in repository.live_workers(db, self._pace.stale_s)}
            if moved := engine.adopt_older_protocols(db, spoken):
                repository.set_protocol(db, moved, engine.PROTOCOL)
                log.warning("moved %d jobs to job protocol %d", len(moved), engine.PROTOCOL)

    def _reap(self) -> None:
        """Put the jobs of dead workers back on the queue, and jobs of our own that have not run here since the last look."""
        if time.monotonic() < self._may_reap_at:
            return
        self.adopt()
        with new_session() as db:
            live = {worker.id for worker in repository.live_workers(db, self._pace.stale_s)}
            owners = engine.owners(db)
        lost = {job_id for job_id, owner in owners.items() if owner == self._identity.id} - set(self._runner.running())
        if again := sorted(lost & self._lost):
            # what the engine wrote while the database took no writes is gone, and nothing of it runs
            engine.requeue(again)
            log.warning("jobs %s were ours and did not run: they are on the queue again", ", ".join(again))
        self._lost = lost - set(again)
        dead = sorted(set(owners.values()) - live)
        if dead:
            found = engine.recover(dead)
            log.warning("recovered %d jobs of %s", len(found), ", ".join(dead))

    def _end_given_up(self) -> None:
        """Fail jobs that the engine will never run again."""
        with new_session() as db:
            # rows first: a job that is submitted in between is then not missed in the engine's table
            given_up = engine.ended(db, repository.live_ids(db))
        for job_id, reason in given_up.items():
            if job_id in self._runner.running():
                continue
            with transaction(_ACTOR) as db:
                set_actor(db, _ACTOR, request_id=job_id)
                job = repository.locked(db, job_id)
                if job.cancel_requested_at is not None:
                    repository.end_job(db, job, JobStatus.CANCELLED)
                else:
                    repository.end_job(db, job, JobStatus.FAILED, error=_why_given_up(reason))

    def tidy(self) -> None:
        """Remove the engine's rows and the folders of jobs that ended long ago."""
        engine.delete_finished(database_url(), KEEP_FINISHED)
        with transaction(_ACTOR) as db:
            repository.forget_workers(db, KEEP_FINISHED.total_seconds())
            folders = {path.name: path for path in get_settings().jobs_dir.glob("*") if path.is_dir()}
            old = repository.ended_before(db, list(folders), KEEP_FINISHED / timedelta(days=1))
        for name in old:
            shutil.rmtree(folders[name])


def run_worker(slots: int, stop_event: threading.Event, pace: Pace | None = None, beat: Callable[[], None] = lambda: None) -> None:
    """Run jobs until `stop_event` is set; then kill the children and leave unfinished jobs to the next worker.

    Args:
        slots: compute steps to run side by side.
        stop_event: set by the caller's signal handler.
        pace: how often to do what.
        beat: called whenever the worker has looked after everything.

    Raises:
        IdentityLost: another process took this worker's name; its jobs are left alone.
    """
    pace = pace or Pace()
    identity = Identity()
    worker_id = identity.claim()
    runner = JobRunner(worker_id, slots)
    monitor = WorkerMonitor(identity, runner, pace)
    monitor.beat()  # before the first job, or others would take it for a dead worker's
    monitor.adopt()
    engine.launch(database_url(), worker_id, slots, runner.run)
    log.info("worker %s takes jobs, %d at a time", worker_id, slots)
    try:
        while not stop_event.wait(CANCEL_POLL_S):
            monitor.look()
            beat()
    finally:
        _stop(identity, runner)


def _stop(identity: Identity, runner: JobRunner) -> None:
    if not runner.stop(_STOP_WAIT_S):
        log.warning("jobs %s did not stop in time; they are recovered later", ", ".join(runner.running()))
    engine.shutdown()
    try:
        with transaction(_ACTOR) as db:
            engine.forgive_attempt(db, identity.id)
            repository.leave(db, identity.id)
    except DBAPIError as error:
        log.warning(
            "the database is away, so that other workers learn only later that %s stopped: %s", identity.id, type(error.orig).__name__
        )
    identity.release()


def _why_given_up(reason: str) -> str:
    if reason == "MAX_RECOVERY_ATTEMPTS_EXCEEDED":
        return (
            f"The worker died {engine.MAX_RECOVERIES + 1} times while it ran this job, so the job was given up."
            " Look at the worker's log and the machine's memory, then retry it."
        )
    return f"The job's place in the queue is gone ({reason.lower()}), as after a database restored from a backup. Retry the job."
