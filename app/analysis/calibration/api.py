"""REST routes of the calibration."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.accounts.deps import CurrentCaller
from app.analysis.calibration import service as calibration
from app.analysis.calibration.export import calibration_to_csv
from app.analysis.calibration.schemas import CalibrationOut
from app.platform.database import Db
from app.platform.web.csv_files import download
from app.platform.web.schemas import problems
from app.study.deps import CurrentParticipant

router = APIRouter(responses=problems(401, 403, 404, 422))


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


def calibration_csv_of(found: CalibrationOut) -> Response:
    """A calibration as a CSV download."""
    return download(calibration_to_csv(found), f"{found.participant}-calibration.csv")
