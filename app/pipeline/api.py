"""Routes of jobs."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Query, Response
from fastapi.responses import StreamingResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CallerNow, CurrentCaller
from app.pipeline import service
from app.pipeline.deps import CurrentJob
from app.pipeline.schemas import JobIn, JobOut, JobStepOut
from app.platform.database import Db, now
from app.platform.jobs import repository as jobs
from app.platform.jobs import stream
from app.platform.web.schemas import Page, PagingQuery, problems
from app.study.deps import CurrentParticipant
from app.tables.jobs import Job, JobStatus
from app.tables.participants import Participant

# Jobs as API types.


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


# REST routes of jobs of every kind: start, look, follow, cancel, retry.

router = APIRouter(tags=["jobs"], responses=problems(401, 403, 404, 422))


@router.post(
    "/participants/{code}/jobs",
    status_code=202,
    responses={200: {"model": JobOut, "description": "The same job waits or runs already: that one; no other was started."}},
)
def start_job(participant: CurrentParticipant, body: JobIn, db: Db, caller: CurrentCaller, response: Response) -> JobOut:
    """Start a job; everything but `kind` has a default. It needs the threshold xi_beta and at least one usable session.

    If a job of the same kind and params waits, or runs on the current data, the same request returns that job (200). Otherwise it starts
    one (202). A request may therefore be sent again after a timeout; `again` starts another job all the same. There is one
    `next_generation` at a time.
    """
    params = body.model_dump(mode="json", exclude={"kind", "again", "bulk"})
    started = service.start_job(db, participant, body.kind, params, caller, again=body.again, bulk=body.bulk)
    response.status_code = 202 if started.new else 200
    return job_out(started.job, participant)


@router.get("/participants/{code}/jobs")
def list_jobs(
    participant: CurrentParticipant,
    db: Db,
    paging: PagingQuery,
    status: Annotated[JobStatus | None, Query(description="Only jobs of this status.")] = None,
) -> Page[JobOut]:
    """List the jobs of a participant, newest first."""
    rows, total = jobs.find(db, participant.id, status=(status,) if status else (), limit=paging.limit, offset=paging.offset)
    return Page(items=[job_out(j, participant) for j in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.get("/jobs/{job_id}")
def read_job(found: CurrentJob) -> JobOut:
    """Return one job with its steps."""
    return job_out(found.job, found.participant)


@router.get(
    "/jobs/{job_id}/events",
    response_class=StreamingResponse,
    responses={200: {"content": {"text/event-stream": {}}, "description": "Server-sent events until the job ends."}},
)
def follow_job(
    found: CurrentJob, db: Db, caller_now: CallerNow, last_event_id: Annotated[str | None, Header(max_length=20)] = None
) -> StreamingResponse:
    """Follow a job: its state, what happens (`status`, `step`, `progress`, `points`, `log`), `end`; goes on after Last-Event-ID."""
    job_id, site = found.job.id, (found.participant.site.study_id, found.participant.site_id)

    def still(present: Session) -> bool:
        caller = caller_now(present)
        return caller is not None and caller.may(can.READ, *site)

    # the stream may last for hours and reads with sessions of its own: this one's connection goes back now
    db.close()
    return StreamingResponse(
        stream.job_events(job_id, last_event_id, still), media_type="text/event-stream", headers={"X-Accel-Buffering": "no"}
    )


@router.post("/jobs/{job_id}/cancel", responses=problems(409))
def cancel_job(found: CurrentJob, db: Db, caller: CurrentCaller) -> JobOut:
    """Cancel a job: a waiting one ends at once, a running one within 2 s."""
    job = service.cancel_job(db, found.participant, found.job, caller)
    return job_out(job, found.participant)


@router.post("/jobs/{job_id}/retry", status_code=202, responses=problems(409))
def retry_job(found: CurrentJob, db: Db, caller: CurrentCaller) -> JobOut:
    """Start a new job with the params of one that has ended."""
    job = service.retry_job(db, found.participant, found.job, caller)
    return job_out(job, found.participant)
