"""HTML pages of jobs: the jobs of a participant, one job."""

from __future__ import annotations

import math
from typing import Any, get_args

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.evaluation.methods import names as method_names
from app.learning import repository as learning
from app.learning.schemas import ALGORITHM_NAMES, DEFAULT_SWEEP, AlgorithmName
from app.learning.snapshots import not_ready
from app.pipeline import charts, service
from app.pipeline.deps import CurrentJob
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.jobs import registry
from app.platform.jobs import repository as jobs
from app.platform.jobs import service as job_service
from app.platform.jobs.titles import failure, numbered
from app.platform.numbers import counted
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.schemas import PagingQuery
from app.platform.web.templates import render
from app.study import repository as study
from app.study.access import may, withdrawn_codes
from app.study.deps import CurrentParticipant
from app.tables.jobs import Job, JobStatus
from app.tables.participants import Participant
from ml.ope import registry as estimators

router = APIRouter()

TRAINABLE = [(name, ALGORITHM_NAMES[name]) for name in get_args(AlgorithmName)]
SHOWN_EVENTS = 20_000
LOG_LINES = 200
REFRESH_S = 4
MOST_PARTICIPANTS, MOST_LIVE, MOST_NAMED = 1000, 200, 20
PARAM_NAMES = {
    "actor_lr_high": "Highest learning rate", "actor_lr_low": "Lowest learning rate", "aim": "What the policies learn from",
    "algorithms": "Algorithms", "anchor": "What TD3+BC and ReBRAC are held near", "count": "Policies to train",
    "critic_memory": "Critics see past amplitudes", "distil_updates": "Gradient steps of each student",
    "held_out": "Scored on held-out sessions", "horizon_steps": "Steps estimated ahead", "methods": "Methods of evaluation",
    "parents": "Policies to go on from", "policies": "Policies", "preset": "Size", "seed": "Seed", "sigma": "Noise of distillation",
    "sweep": "Sweep", "tuned": "Fine-tuned from each", "updates": "Gradient steps of each policy",
}  # fmt: skip
"""What a job was asked for, in the words of its form."""
FORM_LABELS = PARAM_NAMES | {"sweep": "Name of the sweep", "updates": "Gradient steps of each"}
"""Fields of the form, as they are called there, for its errors."""
VALUE_NAMES = {
    "aim": {"steps": "step rewards, as in the paper", "return": "step rewards and each step's share of the end-of-session reward",
            "both": "by turns step rewards alone, and with the end-of-session reward"},
    "anchor": {"logged": "the logged amplitudes", "cdbs": "the cDBS amplitude", "best": "the best constant amplitude",
               "both": "by turns the logged and the cDBS amplitude",
               "all": "by turns the best constant amplitude, the logged ones and the cDBS amplitude"},
    "preset": {"full": "full: for a study", "quick": "quick: for a first look"},
}  # fmt: skip


@router.get("/participants/{code}/jobs")
def jobs_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, paging: PagingQuery) -> HTMLResponse:
    """Show jobs of a participant, and the form to start one."""
    return _jobs(request, participant, db, caller, paging.limit, paging.offset)


@router.post("/participants/{code}/jobs")
def start_job(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Start a job from the form; empty fields take the preset's value."""
    given: dict[str, Any] = {name: str(v) for name, v in values.items() if str(v).strip()}
    if algorithms := [str(v) for v in values.getlist("algorithms")]:
        given["algorithms"] = algorithms
    if methods := [str(v) for v in values.getlist("methods")]:
        given["methods"] = methods
    try:
        kinds = registry.kinds()
        kind = kinds.get(given.get("kind", ""))
        if kind is None:
            raise Invalid("The form names no kind of job.", f"Choose one of {', '.join(kinds)}.", field="kind")
        asked = parse(kind.params, {name: v for name, v in given.items() if name != "again"}, FORM_LABELS).model_dump(mode="json")
        started = service.start_job(db, participant, kind.name, asked, caller, again="again" in given)
    except BetaloopError as error:
        db.rollback()
        return _jobs(request, participant, db, caller, 50, 0, error, given)
    return RedirectResponse(f"/jobs/{started.job.id}?done={'started' if started.new else 'same'}", 303)


@router.get("/jobs")
def all_jobs_page(request: Request, db: Db, caller: CurrentCaller, paging: PagingQuery) -> HTMLResponse:
    """Show jobs of every participant that the caller may read: those at work or waiting, then those that ended."""
    participants, _ = study.participants(db, caller, MOST_PARTICIPANTS, 0)
    codes = {p.id: p.code for p in participants}
    live, _ = jobs.find(db, status=jobs.LIVE, limit=MOST_LIVE, participants=codes)
    ended, total = jobs.find(db, status=jobs.ENDED, limit=paging.limit, offset=paging.offset, participants=codes)
    page = render(
        request,
        "pipeline/all_jobs.html",
        codes=codes,
        withdrawn=withdrawn_codes(participants),
        stoppable={p.id for p in participants if may(caller, can.RUN_JOBS, p)},
        startable=[p.code for p in participants if may(caller, can.RUN_JOBS, p)][:MOST_NAMED],
        # those at work, then those that wait, in the order in which they will begin
        live=sorted(live, key=lambda job: (job.status != JobStatus.RUNNING, job.created_at)),
        ended=ended,
        total=total,
        paging=paging,
        titles=_titles(),
        refresh_s=REFRESH_S,
        workers=len(jobs.live_workers(db, job_service.STALE_S)),
    )
    return HTMLResponse(page)


@router.get("/jobs/{job_id}")
def job_page(request: Request, found: CurrentJob, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show one job: progress, learning curves, log."""
    events = jobs.events_after(db, found.job.id, 0, SHOWN_EVENTS)
    live, workers = not JobStatus(found.job.status).ended, jobs.live_workers(db, job_service.STALE_S)
    steps = list(zip(found.job.steps, numbered([s.title for s in found.job.steps]), strict=True))
    page = render(
        request,
        "pipeline/job.html",
        participant=found.participant,
        job=found.job,
        title=_titles().get(found.job.kind, found.job.kind),
        live=live,
        steps=steps,
        failed=failure(found.job.error, {s.key: title for s, title in steps}) if found.job.error else "",
        curves=charts.job_curves(found.job, [e for e in events if e.kind == "points"]),
        log=[e for e in events if e.kind == "log"][-LOG_LINES:],
        params=_in_words(found.job.params),
        refresh_s=REFRESH_S,
        workers=len(workers),
        beyond=job_service.NEWER_WORKER if live and workers and found.job.protocol > max(w.protocol for w in workers) else "",
        in_queue=_in_queue(db, found.job),
        may_run=may(caller, can.RUN_JOBS, found.participant),
    )
    return HTMLResponse(page)


@router.post("/jobs/{job_id}/cancel")
def cancel_job(found: CurrentJob, db: Db, caller: CurrentCaller) -> Response:
    """Cancel a job."""
    service.cancel_job(db, found.participant, found.job, caller)
    return RedirectResponse(f"/jobs/{found.job.id}?done=cancelled", 303)


@router.post("/jobs/{job_id}/retry")
def retry_job(found: CurrentJob, db: Db, caller: CurrentCaller) -> Response:
    """Start the same job again."""
    job = service.retry_job(db, found.participant, found.job, caller)
    return RedirectResponse(f"/jobs/{job.id}?done=started", 303)


def _jobs(
    request: Request,
    participant: Participant,
    db: Session,
    caller: Caller,
    limit: int,
    offset: int,
    error: BetaloopError | None = None,
    given: dict[str, Any] | None = None,
) -> HTMLResponse:
    rows, total = jobs.find(db, participant.id, limit=limit, offset=offset)
    # what keeps every job from starting is shown before anyone tries
    said = error or not_ready(db, participant)
    page = render(
        request,
        "pipeline/jobs.html",
        participant=participant,
        jobs=rows,
        total=total,
        limit=limit,
        offset=offset,
        kinds=[(k.name, k.title) for k in registry.kinds().values() if not k.needs],
        titles=_titles(),
        codes=None,
        stoppable={participant.id} if may(caller, can.RUN_JOBS, participant) else set(),
        chosen=bool((given or {}).keys() - {"kind", "preset"}),
        live=any(not JobStatus(j.status).ended for j in rows),
        refresh_s=REFRESH_S,
        remarks=field_notes(error, given or {}),
        problem=said.problem(request.url.path) if said else None,
        given=given or {},
        default_sweep=DEFAULT_SWEEP,
        algorithms=TRAINABLE,
        given_algorithms=(given or {}).get("algorithms", DEFAULT_SWEEP["algorithms"]),
        methods=estimators.methods(),
        given_methods=(given or {}).get("methods", []),
        workers=len(jobs.live_workers(db, job_service.STALE_S)),
        trained=[p for p in learning.candidates(db, participant.id) if p.kind == "trained"],
        may_run=may(caller, can.RUN_JOBS, participant),
    )
    return HTMLResponse(page, error.status if error else 200)


def _in_queue(db: Session, job: Job) -> str:
    """Say how many jobs begin before a waiting one, and how long they take where that is known."""
    if job.status != JobStatus.QUEUED:
        return ""
    count, seconds = job_service.in_queue(db, job)
    before = f"{counted(count, 'job')} before yours"
    return f"{before}." if seconds is None else f"{before}, about {math.ceil(seconds / 60)} min."


def _titles() -> dict[str, str]:
    return {kind.name: kind.title for kind in registry.kinds().values()}


def _in_words(params: dict[str, Any]) -> list[tuple[str, str]]:
    """List what was asked for, by the names of its form; what was left open is omitted."""
    return [(PARAM_NAMES.get(name, name.replace("_", " ")), _value(name, v)) for name, v in params.items() if v is not None and v != []]


def _value(name: str, value: Any) -> str:
    names: dict[Any, str] = {"methods": method_names(), "algorithms": ALGORITHM_NAMES}.get(name) or VALUE_NAMES.get(name, {})
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(str(names.get(one, one)) for one in (value if isinstance(value, list) else [value]))
