"""HTML pages of evaluation: the ranking, the calibration, the jobs of a participant, one job."""

from __future__ import annotations

from typing import Any, get_args

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import policy as can
from app.accounts.deps import CurrentCaller
from app.accounts.policy import Caller
from app.evaluation import calibration_charts, charts, coverage, ranking, repository, service
from app.evaluation.api import calibration_csv_of, csv_of
from app.evaluation.calibration import calibration
from app.evaluation.calibration_words import in_sentences
from app.evaluation.decision import RULES
from app.evaluation.jobs_api import CurrentJob
from app.evaluation.methods import METHOD_NAMES, METHOD_SHORT, METHODS, QUICK_METHODS
from app.evaluation.schemas import DECISION_NAMES, RANKING_KINDS, EvaluateParams, PipelineParams, RankingFilter, RankingOut
from app.learning import repository as learning
from app.learning.schemas import ALGORITHM_NAMES, AlgorithmName, DistilParams, TrainParams
from app.learning.snapshots import collect
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid, NotFound
from app.platform.forms import FormValues, parse
from app.platform.jobs import repository as jobs
from app.platform.jobs import service as job_service
from app.platform.jobs.models import JobStatus
from app.platform.schemas import Model, PagingQuery
from app.platform.templates import render
from app.study.api import CurrentParticipant
from app.study.models import Participant

router = APIRouter()

KINDS: dict[str, tuple[str, type[Model]]] = {
    "pipeline": ("Between-visit pipeline", PipelineParams),
    "evaluate": ("Evaluate and rank policies", EvaluateParams),
    "train": ("Train policies", TrainParams),
    "distill": ("Distil policies", DistilParams),
}
TRAINABLE = [(name, ALGORITHM_NAMES[name]) for name in get_args(AlgorithmName)]
SHOWN_EVENTS = 20_000
LOG_LINES = 200
REFRESH_S = 4


@router.get("/participants/{code}/ranking")
def ranking_page(
    request: Request,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    method: str | None = None,
    supported: str = "",
    kind: str = "",
    tested: str = "",
) -> HTMLResponse:
    """Policies and ranking; the filter form leaves empty what it does not ask for."""
    shown = parse(RankingFilter, {"supported": supported, "kind": kind, "tested": tested})
    found: RankingOut | None = None
    missing: dict[str, Any] | None = None
    try:
        found = ranking.current_ranking(db, participant, caller, method or None, shown)
    except NotFound as error:
        missing = error.problem(request.url.path)
    page = render(
        request,
        "evaluation/ranking.html",
        participant=participant,
        ranking=found,
        missing=missing,
        forest=charts.forest(found) if found else None,
        references=charts.shown_references(found) if found else [],
        label=charts.label,
        method_names=METHOD_NAMES,
        method_short=METHOD_SHORT,
        decision_names=DECISION_NAMES,
        coverage=coverage,
        rules=RULES,
        shown=shown,
        live=_live_jobs(db, participant),
        kinds={kind: title for kind, (title, _) in KINDS.items()},
        ranking_kinds=RANKING_KINDS,
        refresh_s=REFRESH_S,
        may_run=_may(caller, can.RUN_JOBS, participant),
        may_plan=_may(caller, can.DRAFT_PLAN, participant),
        may_write=_may(caller, can.WRITE_POLICIES, participant),
        readiness=_readiness(db, participant, request) if found is None else None,
        window=participant.current_settings.window,
    )
    return HTMLResponse(page)


@router.get("/participants/{code}/ranking.csv")
def ranking_csv(participant: CurrentParticipant, db: Db, caller: CurrentCaller, method: str | None = None) -> Response:
    """The ranking as CSV, by the method that the page ranks by."""
    return csv_of(ranking.current_ranking(db, participant, caller, method))


@router.get("/participants/{code}/calibration")
def calibration_page(
    request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, method: str | None = None
) -> HTMLResponse:
    """Predicted against actual, by one method on top and by every method in the tables."""
    found = calibration(db, participant, caller)
    if method and method not in found.methods:
        known = f"Choose one of {', '.join(found.methods)}." if found.methods else "Nothing can be compared yet."
        raise Invalid(f"The calibration has no estimates by '{method}'.", known)
    newest = repository.newest_evaluation(db, participant.id)
    usual = newest.default_method if newest is not None else None
    chosen = method or (usual if usual in found.methods else next(iter(found.methods), None))
    page = render(
        request,
        "evaluation/calibration.html",
        participant=participant,
        calibration=found,
        method=chosen,
        method_names=METHOD_NAMES,
        sentences=in_sentences(found, chosen) if chosen else [],
        over_visits=calibration_charts.over_visits(found, chosen) if chosen else None,
        returns=calibration_charts.returns(found, chosen) if chosen else None,
        metrics=calibration_charts.metrics(found) if found.metrics else None,
        outcomes=calibration_charts.quantities(found, chosen) if chosen else [],
        quantity_names=calibration_charts.QUANTITY_NAMES,
    )
    return HTMLResponse(page)


@router.get("/participants/{code}/calibration.csv")
def calibration_csv(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """The calibration as CSV."""
    return calibration_csv_of(calibration(db, participant, caller))


@router.get("/participants/{code}/jobs")
def jobs_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, paging: PagingQuery) -> HTMLResponse:
    """Jobs of a participant, and the form to start one."""
    return _jobs(request, participant, db, caller, paging.limit, paging.offset)


@router.post("/participants/{code}/jobs")
def start_job(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Start a job from the form; empty fields take the preset's value."""
    given: dict[str, Any] = {name: str(v) for name, v in values.items() if str(v).strip()}
    given["algorithms"] = [str(v) for v in values.getlist("algorithms")] or ["ddpg"]
    if methods := [str(v) for v in values.getlist("methods")]:
        given["methods"] = methods
    try:
        if given.get("kind") not in KINDS:
            raise Invalid("The form names no kind of job.", f"Choose one of {', '.join(KINDS)}.")
        params = parse(KINDS[given["kind"]][1], given).model_dump(mode="json")
        job = service.start_job(db, participant, given["kind"], params, caller)
        db.commit()
    except BetaloopError as error:
        db.rollback()
        return _jobs(request, participant, db, caller, 50, 0, error.problem(request.url.path), given, error.status)
    return RedirectResponse(f"/jobs/{job.id}?done=started", 303)


@router.get("/jobs/{job_id}")
def job_page(request: Request, found: CurrentJob, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """One job: progress, learning curves, log."""
    events = jobs.events_after(db, found.job.id, 0, SHOWN_EVENTS)
    page = render(
        request,
        "evaluation/job.html",
        participant=found.participant,
        job=found.job,
        title=KINDS[found.job.kind][0] if found.job.kind in KINDS else found.job.kind,
        live=not JobStatus(found.job.status).ended,
        curves=charts.job_curves(found.job, [e for e in events if e.kind == "points"]),
        log=[e for e in events if e.kind == "log"][-LOG_LINES:],
        params=_in_words({k: v for k, v in found.job.params.items() if v not in (None, [])}),
        refresh_s=REFRESH_S,
        workers=len(jobs.live_workers(db, job_service.STALE_S)),
        may_run=_may(caller, can.RUN_JOBS, found.participant),
    )
    return HTMLResponse(page)


@router.post("/jobs/{job_id}/cancel")
def cancel_job(found: CurrentJob, db: Db, caller: CurrentCaller) -> Response:
    """Cancel a job."""
    service.cancel_job(db, found.participant, found.job, caller)
    db.commit()
    return RedirectResponse(f"/jobs/{found.job.id}?done=cancelled", 303)


@router.post("/jobs/{job_id}/retry")
def retry_job(found: CurrentJob, db: Db, caller: CurrentCaller) -> Response:
    """Start the same job again."""
    job = service.retry_job(db, found.participant, found.job, caller)
    db.commit()
    return RedirectResponse(f"/jobs/{job.id}?done=started", 303)


def _jobs(
    request: Request,
    participant: Participant,
    db: Session,
    caller: Caller,
    limit: int,
    offset: int,
    problem: dict[str, Any] | None = None,
    given: dict[str, Any] | None = None,
    status: int = 200,
) -> HTMLResponse:
    rows, total = jobs.find(db, participant.id, limit=limit, offset=offset)
    page = render(
        request,
        "evaluation/jobs.html",
        participant=participant,
        jobs=rows,
        total=total,
        limit=limit,
        offset=offset,
        kinds=[(kind, title) for kind, (title, _) in KINDS.items()],
        titles={kind: title for kind, (title, _) in KINDS.items()},
        live=any(not JobStatus(j.status).ended for j in rows),
        refresh_s=REFRESH_S,
        problem=problem or _readiness(db, participant, request),
        given=given or {},
        algorithms=TRAINABLE,
        given_algorithms=(given or {}).get("algorithms", ["ddpg"]),
        methods=[(m, METHOD_NAMES[m], m in QUICK_METHODS) for m in METHODS],
        given_methods=(given or {}).get("methods", []),
        workers=len(jobs.live_workers(db, job_service.STALE_S)),
        trained=[p for p in learning.candidates(db, participant.id) if p.kind == "trained"],
        may_run=_may(caller, can.RUN_JOBS, participant),
    )
    return HTMLResponse(page, status)


def _in_words(params: dict[str, Any]) -> dict[str, Any]:
    """What was asked for, with methods and algorithms by their names."""
    names = {"methods": METHOD_NAMES, "algorithms": ALGORITHM_NAMES}
    return {k: [str(names[k].get(one, one)) for one in v] if k in names else v for k, v in params.items()}


def _readiness(db: Session, participant: Participant, request: Request) -> dict[str, Any] | None:
    """Why no job may start yet, as a problem document; None when one may."""
    try:
        collect(db, participant)
    except Invalid as error:
        return error.problem(request.url.path)
    return None


def _live_jobs(db: Session, participant: Participant) -> list[Any]:
    rows, _ = jobs.find(db, participant.id, status=(JobStatus.QUEUED, JobStatus.RUNNING), limit=5)
    return rows


def _may(caller: Caller, permission: str, participant: Participant) -> bool:
    return caller.may(permission, participant.site.study_id, participant.site_id)
