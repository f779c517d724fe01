"""HTML page of the ranking."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.evaluation import verdict_wording, wording
from app.evaluation.estimates import coverage, held_out
from app.evaluation.estimates.methods import names
from app.evaluation.ranking import charts
from app.evaluation.ranking import service as ranking
from app.evaluation.ranking.answer import OFF_SHARE, Answer, answer
from app.evaluation.ranking.export import csv_of
from app.evaluation.ranking.picture import Picture, picture
from app.evaluation.schemas import RANKING_KINDS, RankingFilter, RankingOut
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
from app.study.sessions.repository import ReadOnce
from ml.ope import registry as estimators

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
    answered: Answer | None = None
    drawn: Picture | None = None
    held: dict[str, Any] = {}
    weights: Mapping[str, float] = {}
    correlation: float | None = None
    missing: dict[str, Any] | None = None
    sessions = ReadOnce(db, participant.id)
    try:
        assessment = ranking.current_assessment(db, participant, caller, method or None, sessions)
        found, answered = ranking.ranking_of(db, assessment, shown, sessions), answer(assessment)
        drawn = picture(
            assessment, [*answered.rows, *answered.like_off], found.snapshot.beta_unit, participant.current_settings.lower_bound
        )
        held = held_out.of_evaluation(assessment.evaluation)
        weights, correlation = assessment.weights, assessment.held_out_correlation
    except NotFound as error:
        missing = error.problem(request.url.path)
    live = _live_jobs(db, participant)
    blocked = not_ready(db, participant) if found is None else None
    page = render(
        request,
        "evaluation/ranking.html",
        participant=participant,
        ranking=found,
        answer=answered,
        picture=drawn,
        held=held,
        plainly=verdict_wording.plainly,
        amplitude=wording.amplitude,
        signed=wording.signed,
        chance=wording.chance,
        further=verdict_wording.further_sessions,
        off_share=OFF_SHARE,
        weights=weights,
        correlation=correlation,
        unfolded=bool(method or shown != RankingFilter()),
        margins=participant.margins_in_force,
        levels=participant.current_margins,
        missing=missing,
        forest=charts.forest(found) if found else None,
        references=charts.shown_references(found) if found else [],
        label=charts.label,
        method_names=names(),
        method_short={m.key: m.short for m in estimators.methods()},
        standing_names=verdict_wording.STANDING_NAMES,
        standings={number: row.decided.standing for number, row in answered.everyone().items()} if answered else {},
        coverage=coverage,
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


@router.get("/glossary")
def glossary(request: Request, caller: CurrentCaller) -> HTMLResponse:
    """What the words of the pages mean."""
    return HTMLResponse(render(request, "evaluation/glossary.html"))


@router.get("/participants/{code}/ranking.csv")
def ranking_csv(participant: CurrentParticipant, db: Db, caller: CurrentCaller, method: str | None = None) -> Response:
    """The ranking as CSV, by the method that the page ranks by."""
    return csv_of(ranking.current_ranking(db, participant, caller, method))


def _live_jobs(db: Session, participant: Participant) -> list[Any]:
    rows, _ = jobs.find(db, participant.id, status=(JobStatus.QUEUED, JobStatus.RUNNING), limit=5)
    return rows
