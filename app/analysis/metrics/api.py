"""REST routes of the analysis."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.accounts.deps import CurrentCaller
from app.analysis.metrics import export, service
from app.analysis.metrics.schemas import FiveMetricsOut
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentParticipant
from ml.outcomes import ALL

router = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@router.get(
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
    found = service.five_metrics(db, participant, caller)
    if format != "json":
        return (export.table if format == "csv" else export.svg)([found], participant.code)
    return FiveMetricsOut.model_validate(found)
