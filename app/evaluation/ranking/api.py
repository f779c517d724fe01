"""REST routes of the ranking."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.accounts.deps import CurrentCaller
from app.evaluation.ranking import service as ranking
from app.evaluation.ranking.export import csv_of
from app.evaluation.schemas import Kind, Method, RankingFilter, RankingOut
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.platform.web.templates import Part, make_part
from app.study.deps import CurrentParticipant, ResultsViewed

router = APIRouter(responses=problems(401, 403, 404, 422))


@router.get(
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
    """Candidate policies from best to worst on one snapshot, with every method's estimate, and references beside them."""
    shown = RankingFilter(supported=supported, kind=kind, tested=tested)
    found = ranking.current_ranking(db, participant, caller, method, shown)
    standings = make_part(Part.STANDINGS, db, participant, caller)
    for policy in found.policies:
        policy.standing = standings.get(policy.policy_id)
    return csv_of(found) if format == "csv" else found
