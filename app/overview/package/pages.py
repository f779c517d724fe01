"""The button that downloads a participant's data package."""

from __future__ import annotations

from fastapi import APIRouter, Response

from app.accounts.deps import CurrentCaller
from app.overview.package.export import export_participant
from app.platform.database import Db
from app.study.deps import CurrentParticipant

router = APIRouter()


@router.get("/participants/{code}/export.zip")
def data_package(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Everything of a participant as a Frictionless data package."""
    content = export_participant(db, participant, caller)
    return Response(
        content, media_type="application/zip", headers={"Content-Disposition": f'attachment; filename="{participant.code}.zip"'}
    )
