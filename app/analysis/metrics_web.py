"""HTML pages of the analysis."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import Field

from app.accounts.deps import CurrentCaller
from app.analysis import metrics, metrics_charts
from app.analysis.evidence import evidence
from app.analysis.metrics_charts import view
from app.platform.database import Db
from app.platform.web.schemas import Model, problems
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant
from app.tables.sessions import Controller
from ml.outcomes import ALL, ANY

# API types of the analysis.


class GroupOut(Model):
    """One metric under one controller."""

    controller: Controller
    label: str
    n: int = Field(description="Sessions with a value.")
    median: float | None
    q1: float | None
    q3: float | None
    values: list[float]
    session_ids: list[int] = Field(description="Session of each value.")


class ComparisonOut(Model):
    """One controller against cDBS: two-sided Wilcoxon rank-sum test."""

    controller: Controller
    label: str
    p_value: float | None = Field(description="Unadjusted, as in the paper; null where there is not enough data.")
    p_holm: float | None = Field(description="Adjusted for all comparisons of this answer.")
    method: str | None = Field(description="exact, or normal approximation.")
    n_controller: int
    n_cdbs: int
    difference: float | None = Field(description="Hodges-Lehmann estimate of controller less cDBS, in the metric's unit.")
    low: float | None
    high: float | None
    level: float = Field(description="Coverage of low to high.")
    note: str = Field(description="The check that failed; empty where the test was made.")


class PolicyMetricOut(Model):
    """One metric of one policy: its sessions, and their comparison with cDBS."""

    policy_id: int
    group: GroupOut
    comparison: ComparisonOut


class MetricOut(Model):
    """One of the five metrics."""

    metric: str = Field(description=f"energy, mean_beta, {ANY}.")
    title: str
    unit: str
    groups: list[GroupOut]
    comparisons: list[ComparisonOut]
    policies: list[PolicyMetricOut] = Field(description="The same by policy; p-values unadjusted, with no value of p_holm.")
    notes: list[str]


class ControllerOut(Model):
    """One controller's share of the study."""

    controller: Controller
    label: str
    sessions: int
    minutes: float
    energy_saving_percent: float | None = Field(description="Against the mean energy of the cDBS sessions.")


class ExcludedOut(Model):
    """Session that the analysis excludes."""

    session_id: int
    visit: int
    ordinal: int
    reason: str


class MissingValueOut(Model):
    """A metric that a session which counts does not have."""

    session_id: int
    visit: int
    ordinal: int
    metric: str
    reason: str


class ContradictionOut(Model):
    """A session whose amplitudes are not those of its controller; it counts until it is corrected."""

    session_id: int
    visit: int
    ordinal: int
    controller: Controller
    mean_fraction: float = Field(description="Mean amplitude fraction of its steps; cDBS = 1.")
    text: str


class FiveMetricsOut(Model):
    """The five metrics of each controller against cDBS."""

    participant: str
    sessions: int = Field(description="Sessions that count.")
    controllers: list[ControllerOut]
    metrics: list[MetricOut]
    excluded: list[ExcludedOut]
    missing: list[MissingValueOut]
    warnings: list[ContradictionOut]
    limits: list[str]


# REST routes of the analysis.

api = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@api.get(
    "/participants/{code}/analyses",
    response_model=FiveMetricsOut,
    description=f"Energy, mean beta, {ALL} by controller and policy, each compared with cDBS by a Wilcoxon rank-sum test.",
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}, "image/svg+xml": {"schema": {"type": "string"}}}}},
)
def read_analyses(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    format: Annotated[Literal["json", "csv", "svg"], Query(description="csv: a row per metric and controller or policy.")] = "json",
) -> FiveMetricsOut | Response:
    """Return the metrics by controller and policy, each compared with cDBS."""
    found = metrics.five_metrics(db, participant, caller)
    if format != "json":
        if format == "svg":
            return metrics_charts.svg([found], participant.code, synthetic=participant.synthetic)
        return metrics_charts.table([found], participant.code)
    return FiveMetricsOut.model_validate(found)


pages = APIRouter()


@pages.get("/participants/{code}/analyses/paper")
def analyses(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the five metrics by controller, with tests, tables and limits."""
    held = evidence(db, participant, caller)
    analysis = view(metrics.five_metrics(db, participant, caller, held), held.key)
    return HTMLResponse(render(request, "analysis/analyses.html", participant=participant, analysis=analysis))


@pages.get("/participants/{code}/analyses/paper.csv")
def paper_table(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Download the paper's comparisons as a table."""
    return metrics_charts.table([metrics.five_metrics(db, participant, caller)], participant.code)


@pages.get("/participants/{code}/analyses/paper.svg")
def paper_figure(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Download the results figure of one participant."""
    return metrics_charts.svg([metrics.five_metrics(db, participant, caller)], participant.code, synthetic=participant.synthetic)
