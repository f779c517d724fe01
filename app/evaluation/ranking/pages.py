"""HTML page of the ranking."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.evaluation import verdict_wording, wording
from app.evaluation.estimates import coverage, dose_shapes, held_out
from app.evaluation.estimates.methods import names
from app.evaluation.ranking import charts
from app.evaluation.ranking import service as ranking
from app.evaluation.ranking.export import csv_of
from app.evaluation.ranking.judged import Judged
from app.evaluation.schemas import RANKING_KINDS, RankingFilter, RankingOut
from app.evaluation.what_next import what_next
from app.learning.snapshots.service import not_ready
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.jobs import registry
from app.platform.jobs import repository as jobs
from app.platform.web.forms import parse
from app.platform.web.templates import Part, make_part, render, render_part
from app.study.access import may
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.jobs import JobStatus
from app.tables.participants import Participant
from ml.designs import EARLY_RANDOM_SESSIONS
from ml.ope import registry as estimators

router = APIRouter()

REFRESH_S = 4


@router.get("/participants/{code}/ranking", dependencies=[ResultsViewed])
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
    judged: Judged | None = None
    found: RankingOut | None = None
    missing: dict[str, Any] | None = None
    try:
        judged = ranking.current(db, participant, caller, method or None)
        found = ranking.ranking_of(judged, shown)
    except NotFound as error:
        missing = error.problem(request.url.path)
    may_run, may_plan = may(caller, can.RUN_JOBS, participant), may(caller, can.DRAFT_PLAN, participant)
    live = _live_jobs(db, participant)
    blocked = not_ready(db, participant) if found is None else None
    page = render(
        request,
        "evaluation/ranking.html",
        participant=participant,
        ranking=found,
        standings=make_part(Part.TESTED_STANDINGS, db, participant, caller) if found else {},
        answer=judged.answer if judged else None,
        body=_body(judged, found, shown, may_plan, may_run, unfolded=bool(method)) if judged and found else "",
        missing=missing,
        live=live,
        kinds={job.kind: registry.kind(job.kind).title for job in live},
        ranking_kinds=RANKING_KINDS,
        refresh_s=REFRESH_S,
        may_run=may_run,
        may_plan=may_plan,
        may_write=may(caller, can.WRITE_POLICIES, participant),
        readiness=blocked.problem(request.url.path) if blocked else None,
        window=participant.current_settings.window,
    )
    return HTMLResponse(page)


def _body(judged: Judged, found: RankingOut, shown: RankingFilter, may_plan: bool, may_run: bool, *, unfolded: bool) -> str:
    """The page below its notes, which is kept: it is made of nothing but what is named here."""
    participant, unfolded = judged.participant, unfolded or shown != RankingFilter()
    settings = participant.current_settings

    def write() -> str:
        answered, assessment = judged.answer, judged.assessment
        return render_part(
            "evaluation/_ranking.html",
            base=f"/participants/{participant.code}",
            code=participant.code,
            random_sessions=EARLY_RANDOM_SESSIONS,
            ranking=found,
            answer=answered,
            picture=judged.picture(settings.bound),
            next=what_next(judged, may_run=may_run),
            held=held_out.of_evaluation(judged.evaluation),
            pooling=[wording.shape_pooling(o, told) for o, told in dose_shapes.pooling(judged.evaluation).items()],
            plainly=verdict_wording.plainly,
            signed=wording.signed,
            test_results=verdict_wording.test_results,
            chance=wording.chance,
            weights=assessment.weights,
            correlation=assessment.held_out_correlation,
            errors=assessment.standard_errors,
            outcomes=assessment.left_out_outcomes,
            outcome_names=wording.OUTCOMES_WITH_UNITS,
            unfolded=unfolded,
            levels=participant.current_margins,
            forest=charts.forest(found),
            references=charts.shown_references(found),
            label=charts.label,
            method_names=names(),
            method_short={m.key: m.short for m in estimators.methods()},
            standing_names=verdict_wording.STANDING_NAMES,
            standings={number: row.decided.standing for number, row in answered.everyone().items()},
            coverage=coverage,
            shown=shown,
            may_run=may_run,
            may_plan=may_plan,
        )

    # `found` less its reasons to be stale, which the page has above, follows from the evaluation, its key and the filter
    name = ("body", participant.code, settings.id, tuple(shown.model_dump().items()), may_plan, may_run, unfolded)
    return judged.kept(name, write)


@router.get("/glossary")
def glossary(request: Request, caller: CurrentCaller) -> HTMLResponse:
    """What the words of the pages mean."""
    return HTMLResponse(render(request, "evaluation/glossary.html"))


@router.get("/participants/{code}/ranking.csv", dependencies=[ResultsViewed])
def ranking_csv(participant: CurrentParticipant, db: Db, caller: CurrentCaller, method: str | None = None) -> Response:
    """The ranking as CSV, by the method that the page ranks by."""
    return csv_of(ranking.current_ranking(db, participant, caller, method))


def _live_jobs(db: Session, participant: Participant) -> list[Any]:
    rows, _ = jobs.find(db, participant.id, status=(JobStatus.QUEUED, JobStatus.RUNNING), limit=5)
    return rows
