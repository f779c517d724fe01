"""REST routes of beta as a biomarker."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.analysis.biomarker import service
from app.analysis.biomarker.schemas import BiomarkerOut
from app.analysis.biomarker.serializers import biomarker_out
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentParticipant

router = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/analyses/beta")
def read_biomarker(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> BiomarkerOut:
    """Beta against amplitude and each QoC, cDBS sessions over the months, and the course after a dose; within and between visits."""
    return biomarker_out(service.biomarker(db, participant, caller))
