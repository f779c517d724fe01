"""Rules of jobs: which may start, and their repetition and cancellation. The caller commits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.learning import repository as learning
from app.platform.jobs import registry, repository
from app.platform.jobs import service as jobs
from app.platform.jobs.models import Job
from app.study import service as study
from app.study.models import Participant


def start_job(db: Session, participant: Participant, kind: str, params: Mapping[str, Any], caller: Caller) -> Job:
    """Put a job of this participant on the queue; of a kind of which there is one at a time, the one that has not ended is given instead.

    Raises:
        UnknownKind: there is no such kind. Invalid: params that break its schema, or something that it requires is not there.
        Forbidden: the caller may not run jobs.
    """
    study.require(caller, can.RUN_JOBS, participant)
    wanted = registry.kind(kind)
    if wanted.one_at_a_time:
        # two requests at once: the second waits here and finds the job of the first
        learning.lock_participant(db, participant.id)
        live, _ = repository.find(db, participant.id, kind, repository.LIVE, limit=1)
        if live:
            return live[0]
    job = jobs.submit(db, kind, participant.id, dict(params), caller.label)
    checked = wanted.params.model_validate(job.params)
    for requirement in wanted.requires:
        requirement(db, participant.id, checked)
    return job


def retry_job(db: Session, participant: Participant, job: Job, caller: Caller) -> Job:
    """A new job with the same params.

    Raises:
        Conflict: the job has not ended, or another one repeats it. NotFound: it is another participant's.
    """
    study.require(caller, can.RUN_JOBS, participant)
    study.require_own(participant, job, f"job {job.id}")
    job = jobs.repeatable(db, job)
    return start_job(db, participant, job.kind, job.params, caller)


def cancel_job(db: Session, participant: Participant, job: Job, caller: Caller) -> Job:
    """Cancel a job. Raises Conflict when it has ended, NotFound for another participant's."""
    study.require(caller, can.RUN_JOBS, participant)
    study.require_own(participant, job, f"job {job.id}")
    return jobs.cancel(db, job, caller.label)
