"""Every query of the job tables."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from datetime import timedelta
from typing import Any

from sqlalchemy import ColumnElement, Interval, delete, func, literal, select, text, tuple_, update
from sqlalchemy.orm import Session, selectinload

from app.platform.database import now
from app.platform.errors import NotFound
from app.tables.jobs import Job, JobEvent, JobStatus, JobStep, Worker

LIVE = (JobStatus.QUEUED, JobStatus.RUNNING)
TYPICAL = 20
ENDED = (JobStatus.SUCCEEDED, JobStatus.FAILED, JobStatus.CANCELLED)


def get(db: Session, job_id: str) -> Job:
    """Load a job with its steps. Raises NotFound if there is none."""
    job = db.scalar(select(Job).where(Job.id == job_id).options(selectinload(Job.steps)))
    if job is None:
        raise NotFound(f"There is no job {job_id}.")
    return job


def locked(db: Session, job_id: str) -> Job:
    """Load a job's current row and lock it against other changes. Raises NotFound if there is none."""
    job = db.scalar(select(Job).where(Job.id == job_id).with_for_update(key_share=True), execution_options={"populate_existing": True})
    if job is None:
        raise NotFound(f"There is no job {job_id}.")
    return job


def find(
    db: Session,
    participant_id: int | None = None,
    kind: str | None = None,
    status: Sequence[JobStatus] = (),
    limit: int = 50,
    offset: int = 0,
    participants: Collection[int] | None = None,
) -> tuple[list[Job], int]:
    """Find jobs, newest first, with their steps, and their total number; `participants` limits them to these."""
    query = select(Job)
    if participants is not None:
        query = query.where(Job.participant_id.in_(participants))
    if participant_id is not None:
        query = query.where(Job.participant_id == participant_id)
    if kind is not None:
        query = query.where(Job.kind == kind)
    if status:
        query = query.where(Job.status.in_(status))
    total = db.scalar(select(func.count()).select_from(query.subquery())) or 0
    newest = query.order_by(Job.created_at.desc(), Job.id).limit(limit).offset(offset).options(selectinload(Job.steps))
    return list(db.scalars(newest)), total


def of_kind(db: Session, participant_id: int, kind: str) -> Sequence[Job]:
    """Load a participant's jobs of a kind, oldest first."""
    query = select(Job).where(Job.participant_id == participant_id, Job.kind == kind)
    return db.scalars(query.order_by(Job.created_at, Job.id)).all()


def jobs_before(db: Session, job: Job) -> list[str]:
    """List the ids of the jobs that a job repeats, the latest first."""
    found: list[str] = []
    while (earlier := db.get_one(Job, found[-1]).repeats if found else job.repeats) is not None:
        found.append(earlier)
    return found


def next_place(db: Session, participant_id: int | None, urgency: int) -> int:
    """Find the place of a new job among the waiting jobs of its urgency, so that studies take turns, and participants within a study.

    The n-th job of a participant comes after the first n - 1 jobs of each other participant of the study, and no further. That count is its
    place behind the job that begins next, whichever study asked for that.
    """
    row = db.execute(
        text(
            "with waiting as (select j.place, j.participant_id, s.study_id, row_number() over"
            " (partition by j.participant_id order by j.place, j.created_at) as number from job j"
            " left join participant p on p.id = j.participant_id left join site s on s.id = p.site_id"
            " where j.status = 'queued' and j.urgency = :urgency),"
            " mine as (select count(*) + 1 as number from waiting where participant_id is not distinct from cast(:participant as int)),"
            " study as (select s.study_id from participant p join site s on s.id = p.site_id where p.id = :participant)"
            " select coalesce((select min(place) from waiting), 0) + (select count(*) from waiting, mine"
            " where waiting.number <= mine.number and waiting.study_id is not distinct from (select study_id from study))"
        ),
        {"participant": participant_id, "urgency": urgency},
    )
    return int(row.scalar_one())


def live_of(db: Session, participant_id: int | None, kind: str | None = None, params: dict[str, Any] | None = None) -> list[Job]:
    """List a participant's jobs that have not ended: all, those of one kind, or those of one kind with the same params."""
    query = select(Job).where(Job.participant_id.is_not_distinct_from(participant_id), Job.status.in_(LIVE))
    if kind is not None:
        query = query.where(Job.kind == kind)
    if params is not None:
        query = query.where(Job.params == params)
    return list(db.scalars(query.order_by(Job.created_at.desc(), Job.id)))


def running(db: Session) -> Sequence[Job]:
    """Load the jobs that run."""
    return db.scalars(select(Job).where(Job.status == JobStatus.RUNNING)).all()


def waiting_before(db: Session, job: Job) -> Sequence[str]:
    """List the kinds of the waiting jobs that begin before a job."""
    order = tuple_(Job.urgency, Job.place, Job.created_at, Job.id)
    own = tuple_(job.urgency, job.place, job.created_at, job.id)
    return db.scalars(select(Job.kind).where(Job.status == JobStatus.QUEUED, order < own)).all()


def typical_seconds(db: Session) -> dict[str, float]:
    """Compute the median length of the last TYPICAL jobs of each kind that succeeded, s."""
    number = func.row_number().over(partition_by=Job.kind, order_by=Job.finished_at.desc())
    length = func.extract("epoch", Job.finished_at - Job.started_at)
    of_kind = select(Job.kind, length.label("length"), number.label("number")).where(Job.status == JobStatus.SUCCEEDED).subquery()
    median = func.percentile_cont(0.5).within_group(of_kind.c.length)
    rows = db.execute(select(of_kind.c.kind, median).where(of_kind.c.number <= TYPICAL).group_by(of_kind.c.kind))
    return {kind: float(seconds) for kind, seconds in rows}


def step(db: Session, job_id: str, key: str) -> JobStep:
    """Load a step of a job; it must have been declared."""
    return db.scalars(select(JobStep).where(JobStep.job_id == job_id, JobStep.key == key)).one()


def add_event(db: Session, job_id: str, kind: str, data: dict[str, Any], step_key: str | None = None) -> None:
    """Say something in a job's name; the job's row must be locked, so that events become visible in the order of their numbers."""
    db.add(JobEvent(job_id=job_id, step_key=step_key, kind=kind, data=data))
    db.flush()


def events_after(db: Session, job_id: str, last_id: int, limit: int = 500) -> list[JobEvent]:
    """Load the events of a job that came after one, oldest first."""
    return list(db.scalars(select(JobEvent).where(JobEvent.job_id == job_id, JobEvent.id > last_id).order_by(JobEvent.id).limit(limit)))


def end_job(db: Session, job: Job, status: JobStatus, result: dict[str, Any] | None = None, error: str | None = None) -> None:
    """End a job, whose row must be locked; steps that did not end are cancelled. A job that has ended stays as it is."""
    if JobStatus(job.status).ended:
        return
    job.status, job.result, job.error = status, result, error
    job.finished_at = job.updated_at = now()
    job.message = error or ""
    if status == JobStatus.SUCCEEDED:
        job.progress = 1.0
    db.execute(
        update(JobStep)
        .where(JobStep.job_id == job.id, JobStep.status.in_(LIVE))
        .values(status=JobStatus.CANCELLED, finished_at=job.finished_at)
    )
    add_event(db, job.id, "status", {"status": status, "error": error, "progress": job.progress})


def live_ids(db: Session) -> list[str]:
    """List the ids of jobs that have not ended."""
    return list(db.scalars(select(Job.id).where(Job.status.in_(LIVE))))


def cancel_requests(db: Session, job_ids: Sequence[str]) -> set[str]:
    """Find those of these jobs that a user wants cancelled or that have ended."""
    wanted = select(Job.id).where(Job.id.in_(job_ids), Job.cancel_requested_at.is_not(None) | Job.status.not_in(LIVE))
    return set(db.scalars(wanted))


def ended_before(db: Session, job_ids: Sequence[str], days: float) -> set[str]:
    """Find those of these ids whose jobs ended more than `days` ago, or that are no jobs at all."""
    keep = select(Job.id).where(Job.id.in_(job_ids), (Job.finished_at.is_(None)) | (Job.finished_at > func.now() - _seconds(86400 * days)))
    return set(job_ids) - set(db.scalars(keep))


def beat(db: Session, worker_id: str, host: str, pid: int, protocol: int, code_version: str) -> float:
    """Record a worker's heartbeat; returns the seconds since its last one by the database's clock (0 for a new worker)."""
    row = db.execute(
        text(
            "with old as (select seen_at from worker where id = :id)"
            " insert into worker (id, host, pid, protocol, code_version, started_at, seen_at)"
            " values (:id, :host, :pid, :protocol, :code_version, clock_timestamp(), clock_timestamp())"
            " on conflict (id) do update set host = :host, pid = :pid, protocol = :protocol, code_version = :code_version,"
            " seen_at = clock_timestamp(),"
            " started_at = case when worker.pid = :pid then worker.started_at else clock_timestamp() end"
            " returning coalesce(extract(epoch from clock_timestamp() - (select seen_at from old)), 0)"
        ),
        {"id": worker_id, "host": host, "pid": pid, "protocol": protocol, "code_version": code_version},
    )
    return float(row.scalar_one())


def leave(db: Session, worker_id: str) -> None:
    """Remove a worker that stops in order, so that others need not wait until it counts as dead."""
    db.execute(text("delete from worker where id = :id"), {"id": worker_id})


def live_workers(db: Session, stale_s: float) -> list[Worker]:
    """List the workers seen within the last `stale_s` seconds, by the database's clock."""
    return list(db.scalars(select(Worker).where(Worker.seen_at > func.clock_timestamp() - _seconds(stale_s)).order_by(Worker.id)))


def set_protocol(db: Session, job_ids: Collection[str], protocol: int) -> None:
    """Record that other workers than before run these jobs."""
    db.execute(update(Job).where(Job.id.in_(job_ids)).values(protocol=protocol))


def count_unserved(db: Session, stale_s: float) -> tuple[int, int, int]:
    """Count the jobs that have not ended and that no live worker may run, with their newest protocol and that of the workers.

    Zeros where no worker lives at all, which is another matter.
    """
    spoken = max((worker.protocol for worker in live_workers(db, stale_s)), default=None)
    if spoken is None:
        return 0, 0, 0
    count, newest = db.execute(select(func.count(), func.max(Job.protocol)).where(Job.status.in_(LIVE), Job.protocol > spoken)).one()
    return count, newest or 0, spoken


def forget_workers(db: Session, stale_s: float) -> None:
    """Remove workers that have been silent for longer."""
    db.execute(delete(Worker).where(Worker.seen_at < func.clock_timestamp() - _seconds(stale_s)))


def _seconds(seconds: float) -> ColumnElement[timedelta]:
    return literal(timedelta(seconds=seconds), Interval)
