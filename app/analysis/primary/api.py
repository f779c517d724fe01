"""REST routes of the primary analyses."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.accounts.deps import CurrentCaller
from app.analysis.primary import service
from app.analysis.primary.export import primary_csv
from app.analysis.primary.schemas import PrimaryOut
from app.analysis.primary.serializers import primary_out
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.platform.web.templates import Part, make_part
from app.study.deps import CurrentParticipant

router = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@router.get(
    "/participants/{code}/analyses/primary",
    response_model=PrimaryOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},
)
def read_primary(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    format: Annotated[Literal["json", "csv"], Query(description="csv: one row per controller or policy and metric.")] = "json",
) -> PrimaryOut | Response:
    """Each controller and policy against the same visit's cDBS, with the visit as the unit of evidence, and the verdicts on the margins."""
    found = service.primary(db, participant, caller)
    standings = make_part(Part.STANDINGS, db, participant, caller)
    return primary_csv(found, standings) if format == "csv" else primary_out(found, standings)
