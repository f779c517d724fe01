"""HTML page of the ranking."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.evaluation import wording
from app.evaluation.estimates import coverage, dose_shapes, held_out
from app.evaluation.estimates.coverage import CHECKS
from app.evaluation.methods import Method, names
from app.evaluation.ranking import charts, verdict_wording
from app.evaluation.ranking import service as ranking
from app.evaluation.ranking.judged import Judged
from app.evaluation.ranking.picture import make_strips
from app.evaluation.ranking.verdict_wording import what_next
from app.evaluation.schemas import RANKING_KINDS, FlagOut, Kind, RankedPolicy, RankingFilter, RankingOut, TestedBefore
from app.learning.snapshots import not_ready
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.jobs import registry
from app.platform.jobs import repository as jobs
from app.platform.web.csv_files import download, safe_cell
from app.platform.web.forms import parse
from app.platform.web.schemas import problems
from app.platform.web.templates import Part, make_part, render, render_part
from app.study.access import may
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.jobs import JobStatus
from app.tables.participants import Participant
from ml.ope import registry as estimators
from ml.outcomes import FIELDS

# The ranking as a table for other programs: every column that the page and the REST interface have.

_PREDICTED = ("energy", "mean_amplitude", "mean_beta", *FIELDS)
_NUMBERS = ("value", "low", "high", "level", "standard_error", "n", "step_return", "end_reward")
_OF_RANKING = ("participant", "evaluation_id", "created_at", "default_method", "horizon_steps", "gamma", "stale")
_OF_POLICY = (
    "rank",
    "policy_id",
    "name",
    "kind",
    "algorithm",
    "reference",
    "retired",
    "decision",
    "decision_reason",
    "standing",
    "probability_best",
)
_GAIN = ("value", "low", "high")
_TESTED = tuple(name for name in TestedBefore.model_fields if name != "visits")
_COVERAGE = tuple(CHECKS)


def to_csv(ranking: RankingOut) -> str:
    """Write one row per policy and method. Rank, decision, gain over cDBS and probability of being best are by the default method. Coverage
    is of the policy whatever the method; `supported` and the later columns are of the row's own method.
    """
    sink = io.StringIO()
    out = csv.writer(sink, lineterminator="\n")
    own = ["method", "supported", *_NUMBERS, *_PREDICTED, "flags"]
    whole = [*_OF_RANKING, "snapshot_id", "settings_version", "beta_unit"]
    out.writerow([*whole, *_OF_POLICY, *(f"gain_{n}" for n in _GAIN), *_coverage_columns(), *own, *(f"tested_{n}" for n in _TESTED)])
    for p in (*ranking.policies, *ranking.references):
        of_ranking = [getattr(ranking, n) for n in _OF_RANKING]
        of_ranking += [ranking.snapshot.id, ranking.snapshot.settings_version, ranking.snapshot.beta_unit]
        of_policy = [getattr(p, n) for n in _OF_POLICY] + [getattr(p.gain, n) if p.gain else None for n in _GAIN]
        of_policy += _coverage(p)
        results = [getattr(p.tested, n) if p.tested else (0 if n.startswith("sessions") else None) for n in _TESTED]
        for method, e in p.estimates.items():
            numbers = [method, e.supported, *(getattr(e, n) for n in _NUMBERS), *(e.predicted.get(n) for n in _PREDICTED)]
            out.writerow([safe_cell(cell) for cell in (*of_ranking, *of_policy, *numbers, _texts(e.flags), *results)])
    return sink.getvalue()


def _texts(flags: Sequence[FlagOut]) -> str:
    return "; ".join(flag.text for flag in flags)


def _coverage_columns() -> list[str]:
    return [*(f"coverage_{n}" for n in ("supported", "failing", "notes")), *(f"coverage_{n}" for n in _COVERAGE)]


def _coverage(p: RankedPolicy) -> list[object]:
    """Return the checks of a policy; empty cells where they were not made."""
    if p.coverage is None:
        return [None] * len(_coverage_columns())
    values = {c.name: c.value for c in p.coverage.checks}
    return [p.coverage.supported, _texts(p.coverage.failing), _texts(p.coverage.notes), *(values.get(n) for n in _COVERAGE)]


def csv_of(found: RankingOut) -> Response:
    """Serve a ranking as a CSV download."""
    return download(to_csv(found), f"{found.participant}-ranking-{found.evaluation_id}.csv")


# REST routes of the ranking.

api = APIRouter(responses=problems(401, 403, 404, 422))


@api.get(
    "/participants/{code}/ranking",
    tags=["evaluation"],
    response_model=RankingOut,
    dependencies=[ResultsViewed],
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},
)
def read_ranking(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    format: Annotated[Literal["json", "csv"], Query(description="csv: one row per policy and method.")] = "json",
    method: Annotated[Method | None, Query(description="Rank by this method instead of the default one.")] = None,
    supported: Annotated[bool, Query(description="Only candidates that the data support.")] = False,
    kind: Annotated[Kind | None, Query(description="Only candidates of this kind.")] = None,
    tested: Annotated[Literal["yes", "no"] | None, Query(description="Only candidates that ran in a session, or that did not.")] = None,
) -> RankingOut | Response:
    """Return candidate policies from best to worst on one snapshot, with every method's estimate, and references besides them."""
    shown = RankingFilter(supported=supported, kind=kind, tested=tested)
    found = ranking.current_ranking(db, participant, caller, method, shown)
    standings = make_part(Part.STANDINGS, db, participant, caller)
    for policy in found.policies:
        policy.standing = standings.get(policy.policy_id)
    return csv_of(found) if format == "csv" else found


pages = APIRouter()

REFRESH_S = 4


@pages.get("/participants/{code}/ranking", dependencies=[ResultsViewed])
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
    """Show policies and ranking; an empty field of the filter form matches all."""
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
        suggested=make_part(Part.SUGGESTED_VISIT, db, participant, caller, judged) if judged else None,
        next=what_next(judged, may_run=may_run) if judged else "",
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
    """Render the page below its notes, which is cached: it is made of nothing but what is named here."""
    participant, unfolded = judged.participant, unfolded or shown != RankingFilter()
    settings = participant.current_settings

    def write() -> str:
        answered, assessment = judged.answer, judged.assessment
        return render_part(
            "evaluation/_ranking.html",
            base=f"/participants/{participant.code}",
            code=participant.code,
            ranking=found,
            answer=answered,
            picture=judged.picture(settings.bound),
            held=held_out.of_evaluation(judged.evaluation),
            pooling=[wording.shape_pooling(o, told) for o, told in dose_shapes.pooling(judged.evaluation).items()],
            plainly=verdict_wording.plainly,
            signed=wording.signed,
            test_results=verdict_wording.test_results,
            dose_words=verdict_wording.dose_words,
            reliability=verdict_wording.reliability(),
            chance=wording.chance,
            amplitude=wording.amplitude,
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
            strips=make_strips(answered, participant.margins_in_force),
            standing_names=verdict_wording.STANDING_NAMES,
            group_names=verdict_wording.GROUP_NAMES,
            standings={number: row.decided.standing for number, row in answered.everyone().items()},
            coverage=coverage,
            shown=shown,
            may_run=may_run,
            may_plan=may_plan,
        )

    # `found` less its reasons to be stale, which the page has above, follows from the evaluation, its key and the filter
    name = ("body", participant.code, settings.id, tuple(shown.model_dump().items()), may_plan, may_run, unfolded)
    return judged.kept(name, write)


@pages.get("/glossary")
def glossary(request: Request, caller: CurrentCaller) -> HTMLResponse:
    """Show what the words of the pages mean."""
    return HTMLResponse(render(request, "evaluation/glossary.html"))


@pages.get("/participants/{code}/ranking.csv", dependencies=[ResultsViewed])
def ranking_csv(participant: CurrentParticipant, db: Db, caller: CurrentCaller, method: str | None = None) -> Response:
    """Download the ranking as CSV, by the method that the page ranks by."""
    return csv_of(ranking.current_ranking(db, participant, caller, method))


def _live_jobs(db: Session, participant: Participant) -> list[Any]:
    rows, _ = jobs.find(db, participant.id, status=(JobStatus.QUEUED, JobStatus.RUNNING), limit=5)
    return rows
