"""REST routes of all participants together."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.accounts.deps import CurrentCaller
from app.analysis.metrics import export
from app.analysis.pooled import service
from app.analysis.pooled.schemas import PooledOut
from app.analysis.pooled.serializers import computation_table, pooled_out, trial_table
from app.analysis.tables import csv_of
from app.platform.database import Db
from app.platform.web.csv_files import download
from app.platform.web.schemas import problems

router = APIRouter(tags=["analysis"], responses=problems(401, 403, 422))


@router.get(
    "/analyses",
    response_model=PooledOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}, "image/svg+xml": {"schema": {"type": "string"}}}}},
)
def read_pooled(
    db: Db,
    caller: CurrentCaller,
    format: Annotated[
        Literal["json", "csv", "svg"], Query(description="csv, svg: the paper's comparisons as a table, its results figure.")
    ] = "json",
    table: Annotated[
        Literal["comparisons", "trial_time", "computation_time"],
        Query(description="Which table the CSV is; the figure is always the results."),
    ] = "comparisons",
) -> PooledOut | Response:
    """Every participant that the caller may read, and all together: verdicts, random-effects summary, trial time, computation time."""
    participants = service.readable(db, caller)
    if format == "csv" and table == "computation_time":
        return download(csv_of(*computation_table(service.computation_times(db, participants))), "computation-time.csv")
    found = service.pooled(db, participants, caller)
    if format == "csv" and table == "trial_time":
        return download(csv_of(*trial_table(found.trial)), "trial-time.csv")
    if format != "json":
        return (export.table if format == "csv" else export.svg)(found.paper, "all")
    return pooled_out(found, service.computation_times(db, participants))
