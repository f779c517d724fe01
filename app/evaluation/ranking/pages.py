"""HTML page of the ranking."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.evaluation.decision import RULES
from app.evaluation.estimates import coverage
from app.evaluation.estimates.methods import names
from app.evaluation.ranking import charts
from app.evaluation.ranking import service as ranking
from app.evaluation.ranking.export import csv_of
from app.evaluation.schemas import DECISION_NAMES, RANKING_KINDS, FlagOut, RankedPolicy, RankingFilter, RankingOut
from app.learning.snapshots.service import not_ready
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.jobs import registry
from app.platform.jobs import repository as jobs
from app.platform.jobs.models import JobStatus
from app.platform.web.forms import parse
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant
from app.study.models import Participant
from app.study.service import may
from ml.ope import registry as estimators
from ml.ope.flags import TEXT

router = APIRouter()

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
    live = _live_jobs(db, participant)
    blocked = not_ready(db, participant) if found is None else None
    page = render(
        request,
        "evaluation/ranking.html",
        participant=participant,
        ranking=found,
        missing=missing,
        forest=charts.forest(found) if found else None,
        references=charts.shown_references(found) if found else [],
        label=charts.label,
        method_names=names(),
        method_short={m.key: m.short for m in estimators.methods()},
        decision_names=DECISION_NAMES,
        beside_decision=_beside_decision,
        coverage=coverage,
        rules=RULES,
        shown=shown,
        live=live,
        kinds={job.kind: registry.kind(job.kind).title for job in live},
        ranking_kinds=RANKING_KINDS,
        refresh_s=REFRESH_S,
        may_run=may(caller, can.RUN_JOBS, participant),
        may_plan=may(caller, can.DRAFT_PLAN, participant),
        may_write=may(caller, can.WRITE_POLICIES, participant),
        readiness=blocked.problem(request.url.path) if blocked else None,
        window=participant.current_settings.window,
    )
    return HTMLResponse(page)


@router.get("/participants/{code}/ranking.csv")
def ranking_csv(participant: CurrentParticipant, db: Db, caller: CurrentCaller, method: str | None = None) -> Response:
    """The ranking as CSV, by the method that the page ranks by."""
    return csv_of(ranking.current_ranking(db, participant, caller, method))


def _beside_decision(policy: RankedPolicy) -> list[FlagOut]:
    """A policy's flags that its decision does not rest on."""
    named = {(r.code, r.value, r.limit) for r in policy.decision_reasons}
    return [f for f in policy.flags if f.code == TEXT or (f.code, f.value, f.limit) not in named]


def _live_jobs(db: Session, participant: Participant) -> list[Any]:
    rows, _ = jobs.find(db, participant.id, status=(JobStatus.QUEUED, JobStatus.RUNNING), limit=5)
    return rows
