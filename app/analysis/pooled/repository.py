"""Queries of the study-wide tables."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Row, func, select
from sqlalchemy.orm import Session

from app.tables.jobs import Job, JobStatus, JobStep


def step_seconds(db: Session, participant_ids: Sequence[int]) -> Sequence[Row[str, str, int, float, float]]:
    """Finished compute steps of these participants' jobs: kind of job, of step (its key up to the number), n, median and longest, s."""
    seconds = func.extract("epoch", JobStep.finished_at - JobStep.started_at)
    name = func.regexp_replace(JobStep.key, "/[0-9]+$", "")
    return db.execute(
        select(Job.kind, name, func.count(), func.percentile_cont(0.5).within_group(seconds), func.max(seconds))
        .join(JobStep, JobStep.job_id == Job.id)
        .where(Job.participant_id.in_(participant_ids), JobStep.status == JobStatus.SUCCEEDED, JobStep.finished_at.is_not(None))
        .group_by(Job.kind, name)
        .order_by(Job.kind, func.min(JobStep.position))
    ).all()
