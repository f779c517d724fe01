"""The durable-workflow engine: the only module that knows DBOS (3.4 or later, below 4).

Every job is one workflow `betaloop.job(job_id)` on one queue, in the schema `dbos` of our own PostgreSQL. DBOS keeps the queue, says which
executor owns a workflow and starts it again after a crash. It records no step: status, steps and results are stored once, in our own tables
(`ledger`). The library leaves three things to us: detect dead executors (`recover`), move jobs to another protocol
(`adopt_older_protocols`, `take_back`), and delete old finished jobs (`delete_finished`).
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Collection, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

from dbos import DBOS, DBOSClient, DBOSConfig, EnqueueOptions, Serializer
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform.jobs.registry import Priority

PROTOCOL = 5
"""Version of the job protocol. Raise it when orchestrations change the keys of their steps, the meaning of recorded results or the params
of a kind. A worker runs jobs of its own protocol, and adopts those of older ones that no live worker speaks.
"""

MAX_RECOVERIES = 3
"""A job whose worker dies this many times after the first is given up: it is likely what kills them."""

APPLICATION = "betaloop"
SCHEMA = "dbos"
QUEUE = "jobs"
URGENT_QUEUE = "urgent"
"""Queue of its own for what a person waits for: it is taken although as many other jobs run as a worker takes."""
MOST_PLACES = 1_000_000
WORKFLOW = "betaloop.job"
QUEUE_POLL_S = 0.5
POOL = {"pool_size": 2, "max_overflow": 18}
"""Connections that the engine keeps when idle, and how many more it opens for a moment; its own measure is to keep all 20."""


class JsonSerializer(Serializer):
    """Arguments and results as readable JSON; an exception keeps its name and text. The default would be pickle, which can run code."""

    def serialize(self, data: Any) -> str:
        """Convert Python to JSON; raises ValueError for NaN and TypeError for what JSON lacks."""
        return json.dumps(data, default=_exception_to_json, allow_nan=False)

    def deserialize(self, serialized_data: str) -> Any:
        """Convert JSON to Python."""
        data = json.loads(serialized_data)
        if isinstance(data, dict) and set(data) == {"__exception__", "text"}:
            return RuntimeError(f"{data['__exception__']}: {data['text']}")
        if isinstance(data, dict) and set(data) == {"args", "kwargs"}:
            return {"args": tuple(data["args"]), "kwargs": data["kwargs"]}
        return data

    def name(self) -> str:
        """Return the name that is stored with each value."""
        return "betaloop_json"


def _exception_to_json(value: Any) -> dict[str, str]:
    if isinstance(value, BaseException):
        return {"__exception__": type(value).__name__, "text": str(value)}
    raise TypeError(f"{type(value).__name__} is not JSON")


class CancelNoise(logging.Filter):
    """Drops the tracebacks that DBOS logs whenever a workflow was cancelled: a cancelled job is no error."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return False for a record about a cancelled workflow."""
        error = record.exc_info[1] if record.exc_info else None
        names = {type(error).__name__, *(base.__name__ for base in type(error).__mro__)} if error else set()
        return not any("Cancelled" in name for name in names) and "CancelledError" not in record.getMessage()


def prepare(url: str) -> None:
    """Create or upgrade the engine's schema; belongs to every run of the migrations."""
    _quieten()
    DBOS.migrate(url, schema=SCHEMA)


def enqueue(db: Session, job_id: str, urgency: int, place: int = 0) -> None:
    """Put a job on the queue within the caller's transaction: it exists when the caller commits, not before.

    Args:
        urgency: a `Priority`. place: order among jobs of one urgency; the smaller begins first.
    """
    queue = QUEUE if urgency > Priority.INTERACTIVE else URGENT_QUEUE
    order = urgency * MOST_PLACES + min(place, MOST_PLACES - 1)
    options: EnqueueOptions = {"workflow_name": WORKFLOW, "queue_name": queue, "workflow_id": job_id, "priority": order}
    options["app_version"] = str(PROTOCOL)
    # the insert must reach the rows that the session holds back, in order
    db.flush()
    client = _client(db.connection().engine.url.render_as_string(hide_password=False))
    client.enqueue_in_transaction(db.connection(), options, job_id)


_clients: dict[str, DBOSClient] = {}
_clients_lock = threading.Lock()


def _client(url: str) -> DBOSClient:
    """Return a client that only writes and reads the queue; it never runs a workflow."""
    with _clients_lock:
        if url not in _clients:
            _quieten()
            _clients[url] = DBOSClient(
                system_database_url=url,
                dbos_system_schema=SCHEMA,
                serializer=JsonSerializer(),
                application_name=APPLICATION,
                system_database_pool_size=2,
                lazy=True,
            )
        return _clients[url]


_runner: Callable[[str], None] | None = None


@DBOS.workflow(name=WORKFLOW, max_recovery_attempts=MAX_RECOVERIES)
def _job_workflow(job_id: str) -> dict[str, Any]:
    if _runner is None:
        raise RuntimeError("this process enqueues jobs and does not run them")
    _runner(job_id)
    return {}


def launch(url: str, executor_id: str, jobs_at_once: int, runner: Callable[[str], None]) -> None:
    """Make this process an executor: resume its own interrupted jobs and take jobs from the queue.

    Args:
        url: SQLAlchemy URL of the database.
        executor_id: no other live process may have it, and a restarted worker should have it again.
        jobs_at_once: jobs this worker takes from each queue at a time.
        runner: runs one job; called in a thread of its own.
    """
    global _runner
    _runner = runner
    config: DBOSConfig = {
        "name": APPLICATION,
        "system_database_url": url,
        "dbos_system_schema": SCHEMA,
        "application_version": str(PROTOCOL),
        "executor_id": executor_id,
        "serializer": JsonSerializer(),
        "log_level": "WARNING",
        "console_log_level": "WARNING",
        "run_migrations": False,
        "db_engine_kwargs": POOL,
        "enable_otlp": False,
    }
    DBOS(config=config)
    _quieten()
    DBOS.launch()
    for queue in (QUEUE, URGENT_QUEUE):
        DBOS.register_queue(queue, worker_concurrency=jobs_at_once, polling_interval_sec=QUEUE_POLL_S, on_conflict="always_update")


def shutdown() -> None:
    """Stop being an executor; jobs that are not finished stay ours until `release`."""
    global _runner
    DBOS.destroy()
    _runner = None


def recover(executor_ids: Sequence[str]) -> list[str]:
    """Put the unfinished jobs of dead executors back on the queue; returns the ids of those that this call found.

    Safe when several workers do it at once. The update asks for PENDING and the dead executor's id, so a job that another worker took
    meanwhile is left alone. The public `resume_workflow` is not safe: it also revives cancelled jobs and resets the count of recoveries.
    Hence a private name, used only here and checked by a contract test.
    """
    return [handle.get_workflow_id() for handle in DBOS._recover_pending_workflows(list(executor_ids))]


def requeue(job_ids: Sequence[str]) -> None:
    """Put jobs that this executor has, and does not run, back on the queue. A job that had ended all the same ends again at once."""
    DBOS.resume_workflows(list(job_ids), queue_name=QUEUE)


def owners(db: Session) -> dict[str, str]:
    """Return the executor of every running job, by job id."""
    rows = db.execute(
        text("select workflow_uuid, executor_id from dbos.workflow_status where status = 'PENDING' and name = :name"), {"name": WORKFLOW}
    )
    return {row.workflow_uuid: row.executor_id for row in rows}


def ended(db: Session, job_ids: Sequence[str]) -> dict[str, str]:
    """Find those of these jobs that the engine will never run again, with their status ('GONE': it has no record of the job)."""
    rows = db.execute(
        text("select workflow_uuid, status from dbos.workflow_status where workflow_uuid = any(:ids)"), {"ids": list(job_ids)}
    )
    known = {row.workflow_uuid: row.status for row in rows}
    return {i: known.get(i, "GONE") for i in job_ids if known.get(i) not in {"ENQUEUED", "DELAYED", "PENDING"}}


def adopt_older_protocols(db: Session, live: Collection[int]) -> list[str]:
    """Move unfinished jobs of older protocols to ours, but those that a live worker speaks; returns their ids. Never the other way.

    DBOS would leave them waiting for ever for a worker of their version. Their finished steps are found by their keys in `job_step`.
    """
    return _move(db, back=False, live=live)


def take_back(db: Session) -> list[str]:
    """Move unfinished jobs of newer protocols to ours, after an upgrade that was given up; returns their ids."""
    return _move(db, back=True)


def _move(db: Session, *, back: bool, live: Collection[int] = ()) -> list[str]:
    rows = db.execute(
        text(
            "update dbos.workflow_status s set application_version = :own from"
            " (select workflow_uuid, cast(application_version as int) as version from dbos.workflow_status"
            " where name = :name and status in ('ENQUEUED', 'DELAYED', 'PENDING')) as found"
            " where found.workflow_uuid = s.workflow_uuid and version <> all(cast(:live as int[]))"
            " and case when :back then version > cast(:own as int) else version < cast(:own as int) end returning s.workflow_uuid"
        ),
        {"own": str(PROTOCOL), "name": WORKFLOW, "back": back, "live": list(live)},
    )
    return list(rows.scalars())


def forgive_attempt(db: Session, executor_id: str) -> None:
    """Reduce the attempts of the jobs that this executor still has by one: an orderly stop is no crash."""
    db.execute(
        text(
            "update dbos.workflow_status set recovery_attempts = greatest(recovery_attempts - 1, 0)"
            " where executor_id = :executor and status = 'PENDING' and name = :name"
        ),
        {"executor": executor_id, "name": WORKFLOW},
    )


def delete_finished(url: str, older_than: timedelta) -> int:
    """Delete the engine's record of jobs that finished long ago (ours stays); returns how many."""
    client = _client(url)
    done = client.list_workflows(
        status=["SUCCESS", "ERROR", "CANCELLED", "MAX_RECOVERY_ATTEMPTS_EXCEEDED"],
        completed_before=(datetime.now(UTC) - older_than).isoformat(),
        name=WORKFLOW,
        limit=1000,
        load_input=False,
        load_output=False,
    )
    if done:
        client.delete_workflows([workflow.workflow_id for workflow in done])
    return len(done)


def _quieten() -> None:
    logger = logging.getLogger("dbos")
    logger.setLevel(logging.WARNING)
    if not any(isinstance(f, CancelNoise) for f in logger.filters):
        logger.addFilter(CancelNoise())
