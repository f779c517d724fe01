"""REST routes of evaluation: the ranking, and the jobs of every kind."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.accounts.deps import CurrentCaller
from app.analysis.calibration import service as calibration
from app.analysis.calibration.schemas import CalibrationOut
from app.evaluation.ranking import service as ranking
from app.evaluation.ranking.export import calibration_to_csv, to_csv
from app.evaluation.schemas import Kind, Method, RankingFilter, RankingOut
from app.pipeline import api as jobs_api
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.api import CurrentParticipant

router = APIRouter(responses=problems(401, 403, 404, 422))
router.include_router(jobs_api.router)

CSV = "text/csv; charset=utf-8"


@router.get(
    "/participants/{code}/ranking",
    tags=["evaluation"],
    response_model=RankingOut,
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
    return csv_of(found) if format == "csv" else found


@router.get(
    "/participants/{code}/calibration",
    tags=["evaluation"],
    response_model=CalibrationOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},
)
def read_calibration(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    format: Annotated[Literal["json", "csv"], Query(description="csv: one row per visit, policy and method.")] = "json",
) -> CalibrationOut | Response:
    """Estimates made before each visit against what the visit brought, and the metrics of every method."""
    found = calibration.calibration(db, participant, caller)
    return calibration_csv_of(found) if format == "csv" else found


def csv_of(found: RankingOut) -> Response:
    """A ranking as a CSV download."""
    return _download(to_csv(found), f"{found.participant}-ranking-{found.evaluation_id}.csv")


def calibration_csv_of(found: CalibrationOut) -> Response:
    """A calibration as a CSV download."""
    return _download(calibration_to_csv(found), f"{found.participant}-calibration.csv")


def _download(content: str, name: str) -> Response:
    return Response(content, media_type=CSV, headers={"Content-Disposition": f'attachment; filename="{name}"'})
