"""FastAPI dependency: the job that a path names, within what the caller may read."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Path, Request

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.jobs import repository as jobs
from app.study.deps import mark_synthetic
from app.tables.jobs import Job
from app.tables.participants import Participant


class ParticipantJob:
    """A job and the participant it works for."""

    def __init__(self, job: Job, participant: Participant) -> None:
        self.job, self.participant = job, participant


def current_job(
    request: Request, job_id: Annotated[str, Path(pattern=r"^[0-9a-fA-F-]{1,36}$")], db: Db, caller: CurrentCaller
) -> ParticipantJob:
    """Find the job that the path names. Raises NotFound for a job of a participant that the caller may not see."""
    job = jobs.get(db, job_id)
    participant = db.get(Participant, job.participant_id) if job.participant_id is not None else None
    if participant is None:
        raise NotFound(f"There is no job {job_id}.")
    caller.require(can.READ, participant.site.study_id, participant.site_id)
    mark_synthetic(request, participant)
    return ParticipantJob(job, participant)


CurrentJob = Annotated[ParticipantJob, Depends(current_job)]
