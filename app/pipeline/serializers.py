"""Jobs as API types."""

from __future__ import annotations

from app.pipeline.schemas import JobOut, JobStepOut
from app.platform.database import now
from app.tables.jobs import Job
from app.tables.participants import Participant


def job_out(job: Job, participant: Participant) -> JobOut:
    """Convert a job for the API."""
    return JobOut(
        id=job.id,
        kind=job.kind,
        participant=participant.code,
        status=str(job.status),
        progress=job.progress,
        seconds_left=job.seconds_left(now()),
        message=job.message,
        params=job.params,
        result=job.result,
        error=job.error,
        code_version=job.code_version,
        created_at=job.created_at,
        created_by=job.created_by,
        started_at=job.started_at,
        finished_at=job.finished_at,
        cancel_requested_at=job.cancel_requested_at,
        steps=[
            JobStepOut(
                key=s.key,
                title=s.title,
                status=str(s.status),
                progress=s.progress,
                message=s.message,
                attempts=s.attempts,
                started_at=s.started_at,
                finished_at=s.finished_at,
            )
            for s in job.steps
        ],
    )
