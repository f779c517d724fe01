"""REST routes of the quarantine: list, review, release, discard."""

from __future__ import annotations

from fastapi import APIRouter, Response

from app.accounts.deps import CurrentCaller
from app.ingest import repository
from app.ingest.quarantine import service as quarantine
from app.ingest.quarantine.serializers import original, quarantined_out
from app.ingest.schemas import QuarantineDiscardIn, QuarantinedOut, ReleaseIn
from app.platform.database import Db
from app.platform.web.schemas import RowId, problems
from app.study.deps import CurrentParticipant

router = APIRouter(tags=["quarantine"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/quarantine")
def list_quarantine(participant: CurrentParticipant, db: Db) -> list[QuarantinedOut]:
    """List files of a participant that could not all be read, newest first, with the decisions on them."""
    return [quarantined_out(f) for f in repository.quarantined_files(db, participant.id)]


@router.post(
    "/uploaded-files/{file_id}/review",
    response_class=Response,
    responses=problems(409) | {200: {"content": {"application/octet-stream": {}}, "description": "The original bytes."}},
)
def review(file_id: RowId, db: Db, caller: CurrentCaller) -> Response:
    """Return the original bytes, which may identify the participant; the audit trail records who looked."""
    return original(quarantine.review(db, file_id, caller), file_id)


@router.post("/uploaded-files/{file_id}/release", responses=problems(409))
def release(file_id: RowId, decision: ReleaseIn, db: Db, caller: CurrentCaller) -> QuarantinedOut:
    """Read a file again with the present decoder, or store it, after review, as it came."""
    if decision.how == "read":
        quarantine.read_again(db, file_id, decision.reason, caller)
    else:
        quarantine.release_as_is(db, file_id, decision.reason, caller)
    return quarantined_out(repository.upload_file(db, file_id, caller)[0])


@router.post("/uploaded-files/{file_id}/discard", responses=problems(409))
def discard(file_id: RowId, decision: QuarantineDiscardIn, db: Db, caller: CurrentCaller) -> QuarantinedOut:
    """Erase the bytes of a quarantined file; its row stays."""
    return quarantined_out(quarantine.discard(db, file_id, decision.reason, caller))
