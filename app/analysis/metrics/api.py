"""REST routes of the analysis."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.analysis.metrics import service
from app.analysis.metrics.schemas import FiveMetricsOut
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentParticipant

router = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/analyses")
def read_analyses(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> FiveMetricsOut:
    """Energy, mean beta, grasp, rating and tremor by controller, each compared with cDBS by a Wilcoxon rank-sum test."""
    return FiveMetricsOut.model_validate(service.five_metrics(db, participant, caller))
