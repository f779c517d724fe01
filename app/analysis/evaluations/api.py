"""REST routes of methods by seed."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.accounts.deps import CurrentCaller
from app.analysis.evaluations import service
from app.analysis.evaluations.export import figure_of, table_of
from app.analysis.evaluations.schemas import BySeedOut
from app.analysis.evaluations.serializers import by_seed_out
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentParticipant

router = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@router.get(
    "/participants/{code}/analyses/evaluations",
    response_model=BySeedOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}, "image/svg+xml": {"schema": {"type": "string"}}}}},
)
def read_by_seed(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    format: Annotated[Literal["json", "csv", "svg"], Query()] = "json",
) -> BySeedOut | Response:
    """Every method of evaluation over seeds on one snapshot, against the returns of the sessions recorded after it."""
    found = service.by_seed(db, participant, caller)
    if format != "json":
        return table_of(found) if format == "csv" else figure_of(found)
    return by_seed_out(found)
