"""Rules of jobs: which may start, and their repetition and cancellation. The caller commits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation.repository import newest_evaluation
from app.learning import repository as learning
from app.learning.snapshots import collect
from app.pipeline.stages import PLAN, snapshot_facts
from app.platform.jobs import Priority, registry
from app.platform.jobs import service as jobs
from app.study import access
from app.tables.jobs import Job
from app.tables.participants import Participant


class Started(NamedTuple):
    """A job that was asked for, and whether it is a new one."""

    job: Job
    new: bool


def start_job(
    db: Session,
    participant: Participant,
    kind: str,
    params: Mapping[str, Any],
    caller: Caller,
    *,
    again: bool = False,
    bulk: bool = False,
    repeats: Job | None = None,
) -> Started:
    """Put a job of this participant on the queue, unless the same one is there: a request that is sent twice starts one job.

    Instead a job may be returned that has not ended. Of a kind with one job at a time, it is that job, whatever it was asked for. Of others
    it is one with the same params and data, unless `again` asks for another.

    Raises:
        UnknownKind: there is no such kind. Invalid: params that break its schema, or something that it requires is not there.
        Forbidden: the caller may not run jobs. Conflict: the participant has withdrawn, or the study has ended, meanwhile.
    """
    access.require(caller, can.RUN_JOBS, participant)
    wanted = registry.kind(kind)
    checked = jobs.checked_params(kind, params)
    access.require_still_taking_part(db, participant)  # an end cancels the jobs that it sees: one that came later would run
    # two requests at once: the second waits here and finds the job of the first
    learning.lock_participant(db, participant.id)
    if not again or wanted.one_at_a_time:
        for live in jobs.live_of(db, participant.id, kind, None if wanted.one_at_a_time else checked):
            if wanted.one_at_a_time or _same(db, participant, live):
                return Started(live, False)
    # a participant's first ranking is waited for, later pipelines are not
    first = kind == "pipeline" and newest_evaluation(db, participant.id) is None
    urgency = Priority.BATCH if bulk else Priority.INTERACTIVE if first else wanted.priority
    job = jobs.submit(db, kind, participant.id, checked, caller.label, repeats, urgency)
    for requirement in wanted.requires:
        requirement(db, participant.id, checked)
    return Started(job, True)


def _same(db: Session, participant: Participant, live: Job) -> bool:
    """Decide whether a job that has not ended does what these params ask for. One that waits reads its data when it begins, as a new one
    would."""
    if live.cancel_requested_at is not None:
        return False
    planned = next((s for s in live.steps if s.key == PLAN and s.result is not None), None)
    if planned is None or planned.result is None or planned.finished_at is None:
        return True
    now = learning.snapshot_by_pins(db, participant.id, collect(db, participant).pins_sha256)
    if now is None or snapshot_facts(db, now) != planned.result["snapshot"]:
        return False
    return not any(p.job_id != live.id and p.created_at > planned.finished_at for p in learning.candidates(db, participant.id))


def retry_job(db: Session, participant: Participant, job: Job, caller: Caller) -> Job:
    """Start a new job with the same params, whichever else is at work. It takes over the results that its steps would compute again.

    Raises:
        Conflict: the job has not ended, or another one repeats it. NotFound: it is another participant's.
    """
    access.require(caller, can.RUN_JOBS, participant)
    access.require_own(participant, job, f"job {job.id}")
    job = jobs.repeatable(db, job)
    return start_job(db, participant, job.kind, job.params, caller, again=True, repeats=job).job


def cancel_job(db: Session, participant: Participant, job: Job, caller: Caller) -> Job:
    """Cancel a job. Raises Conflict when it has ended, NotFound for another participant's."""
    access.require(caller, can.RUN_JOBS, participant)
    access.require_own(participant, job, f"job {job.id}")
    return jobs.cancel(db, job, caller.label)
