"""Submit, cancel and retry jobs. The caller commits."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from sqlalchemy.orm import Session

from app import __version__
from app.platform.database import now
from app.platform.errors import Conflict, Invalid
from app.platform.jobs import engine, registry, repository
from app.platform.jobs.repository import events_after as events_after
from app.tables.jobs import Job, JobEvent, JobStatus

STALE_S = 20.0
"""A worker that is silent for longer is taken for dead."""

NEWER_WORKER = (
    "Start a worker of the newer version. To go on with the older version instead, run its `betaloop take-back-jobs`."
    " Finished steps are kept."
)

_ROOT = Path(__file__).resolve().parents[3]


def checked_params(kind: str, params: Mapping[str, Any]) -> BaseModel:
    """Validate params by the schema of their kind, with its defaults. Raises UnknownKind, Invalid: as `submit`."""
    try:
        return registry.kind(kind).params.model_validate(dict(params))
    except ValidationError as error:
        errors = error.errors(include_url=False, include_context=False, include_input=False)
        places = "; ".join(f"{'.'.join(map(str, e['loc'])) or 'params'}: {e['msg']}" for e in errors)
        raise Invalid(f"These params do not fit the job kind {kind!r}: {places}.", errors=errors) from error


def submit(
    db: Session,
    kind: str,
    participant_id: int | None,
    params: dict[str, Any] | BaseModel,
    created_by: str,
    repeats: Job | None = None,
    urgency: int | None = None,
) -> Job:
    """Make a job and put it on the queue, both in the caller's transaction.

    Args:
        db: the session; the job exists when the caller commits.
        kind: a registered name.
        participant_id: whose data it works on.
        params: checked by the kind's schema.
        created_by: the user who asks for it; the audit trail names the worker for them with everything that the job writes.
        urgency: a `Priority`; that of the kind when left open.
        repeats: a job that has ended: the results of its steps are taken over where code and params are the same.

    Raises:
        UnknownKind: there is no such kind.
        Invalid: the params break the kind's schema; `errors` lists where.
    """
    urgency = int(registry.kind(kind).priority if urgency is None else urgency)
    checked = checked_params(kind, params.model_dump(mode="json") if isinstance(params, BaseModel) else params).model_dump(mode="json")
    job = Job(
        id=str(uuid.uuid4()),
        participant_id=participant_id,
        kind=kind,
        status=JobStatus.QUEUED,
        progress=0.0,
        message="",
        params=checked,
        code_version=code_version(),
        protocol=engine.PROTOCOL,
        created_by=created_by,
        repeats=None if repeats is None else repeats.id,
        urgency=urgency,
        place=repository.next_place(db, participant_id, urgency),
    )
    db.add(job)
    db.flush()
    repository.add_event(db, job.id, "status", {"status": JobStatus.QUEUED})
    engine.enqueue(db, job.id, job.urgency, job.place)
    return job


def in_queue(db: Session, job: Job) -> tuple[int, float | None]:
    """Count the jobs that begin before a waiting one, and estimate the seconds until it begins; None where a kind has never run."""
    running, waiting, lengths = repository.running(db), repository.waiting_before(db, job), repository.typical_seconds(db)
    left = [found if (found := one.seconds_left(now())) is not None else lengths.get(one.kind) for one in running]
    times = [*left, *(lengths.get(kind) for kind in waiting)]
    workers = max(1, len(repository.live_workers(db, STALE_S)))
    known = [seconds for seconds in times if seconds is not None]
    return len(waiting), sum(known) / workers if len(known) == len(times) else None


def take_back(db: Session) -> int:
    """Let this version run the unfinished jobs of newer ones, after an upgrade that was given up; returns how many.

    Raises:
        Conflict: a worker of a newer version lives.
    """
    if newer := [worker.id for worker in repository.live_workers(db, STALE_S) if worker.protocol > engine.PROTOCOL]:
        raise Conflict(f"A worker of a newer version lives: {', '.join(newer)}.", "Stop it first, and wait a minute if it was killed.")
    moved = engine.take_back(db)
    repository.set_protocol(db, moved, engine.PROTOCOL)
    return len(moved)


def live_of(db: Session, participant_id: int, kind: str | None = None, params: BaseModel | None = None) -> list[Job]:
    """List a participant's jobs that have not ended: all, those of one kind, or those of one kind with the same params."""
    return repository.live_of(db, participant_id, kind, None if params is None else params.model_dump(mode="json"))


def cancel(db: Session, job: Job, by: str) -> Job:
    """Cancel a job: at once when it waits, or when no worker lives that could run it; else its worker kills it within 2 s.

    Raises:
        Conflict: it has already ended.
    """
    job = repository.locked(db, job.id)
    if JobStatus(job.status).ended:
        raise Conflict(f"Job {job.id} has already {job.status}: there is nothing left to cancel.")
    if job.cancel_requested_at is None:
        job.cancel_requested_at = now()
        repository.add_event(db, job.id, "cancel", {"by": by})
    if job.status == JobStatus.QUEUED or not repository.live_workers(db, STALE_S):
        repository.end_job(db, job, JobStatus.CANCELLED)
    return job


def retry(db: Session, job: Job, by: str) -> Job:
    """Start a new job of the same kind with the same params. Raises as `repeatable` does."""
    job = repeatable(db, job)
    return submit(db, job.kind, job.participant_id, job.params, by, job)


def repeatable(db: Session, job: Job) -> Job:
    """Return the job, its row locked, if it may be repeated.

    Raises:
        Conflict: it has not ended, or another one that has not ended repeats it already.
    """
    # the row's lock makes a second click wait, so that it sees the job of the first
    job = repository.locked(db, job.id)
    if not JobStatus(job.status).ended:
        raise Conflict(f"Job {job.id} is still {job.status}.", "Wait for it or cancel it, then retry.")
    for other in repository.live_of(db, job.participant_id, job.kind, job.params):
        if other.created_at >= job.created_at:
            raise Conflict(f"Job {other.id}, {other.status}, repeats job {job.id} already.", "Wait for it or cancel it, then retry.")
    return job


def describe_event(event: JobEvent) -> dict[str, Any]:
    """Describe an event as the API and the event stream show it."""
    return {"id": event.id, "kind": event.kind, "step": event.step_key, "at": event.at.isoformat(), "data": event.data}


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return version and hash of the source that runs here: the same text means the same code, with git or without."""
    digest = hashlib.sha256()
    for package in ("app", "ml"):
        for path in sorted((_ROOT / package).rglob("*.py")):
            digest.update(path.relative_to(_ROOT).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return f"{__version__}+{digest.hexdigest()[:12]}"
