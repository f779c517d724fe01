"""Rules of jobs: which may start, and their repetition and cancellation. The caller commits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation.ranking.service import current_ranking as current_ranking
from app.evaluation.schemas import EvaluateParams
from app.evaluation.service import policies_to_rank
from app.learning.schemas import DistilParams, TrainParams
from app.learning.snapshots.service import collect
from app.pipeline.learning import teachers, training_starts
from app.pipeline.schemas import PipelineParams
from app.platform.jobs import service as jobs
from app.platform.jobs.models import Job
from app.study import service as study
from app.study.models import Participant


def start_job(db: Session, participant: Participant, kind: str, params: Mapping[str, Any], caller: Caller) -> Job:
    """Put a job of this participant on the queue.

    Raises:
        Invalid: params that break the kind's schema; no beta threshold yet; no usable session; nothing to train from, distil or rank.
        Forbidden: the caller may not run jobs.
    """
    study.require(caller, can.RUN_JOBS, participant)
    collect(db, participant)
    job = jobs.submit(db, kind, participant.id, dict(params), caller.label)
    if kind == "train":
        training_starts(db, participant.id, TrainParams.model_validate(job.params))
    elif kind == "pipeline":
        training_starts(db, participant.id, PipelineParams.model_validate(job.params).training())
    elif kind == "distill":
        teachers(db, participant.id, DistilParams.model_validate(job.params))
    elif kind == "evaluate":
        policies_to_rank(db, participant.id, EvaluateParams.model_validate(job.params))
    return job


def retry_job(db: Session, participant: Participant, job: Job, caller: Caller) -> Job:
    """A new job with the same params. Raises Conflict while the job has not ended, or another one repeats it."""
    study.require(caller, can.RUN_JOBS, participant)
    job = jobs.repeatable(db, job)
    return start_job(db, participant, job.kind, job.params, caller)


def cancel_job(db: Session, participant: Participant, job: Job, caller: Caller) -> Job:
    """Cancel a job. Raises Conflict when it has ended."""
    study.require(caller, can.RUN_JOBS, participant)
    return jobs.cancel(db, job, caller.label)
