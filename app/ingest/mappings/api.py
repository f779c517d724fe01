"""REST routes of column mappings: preview of a waiting table, the mapping that reads it, those of a study."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.ingest.mappings import repository, service
from app.ingest.mappings.schemas import MappedOut, MappingIn, MappingOut, PreviewOut, RemovalIn
from app.ingest.mappings.serializers import applied_out, mapping_out, mappings_out, preview_out
from app.platform.database import Db
from app.platform.web.schemas import RowId, problems

router = APIRouter(tags=["uploads"], responses=problems(401, 403, 404, 422))


@router.get("/uploaded-files/{file_id}/preview")
def preview(file_id: RowId, db: Db, caller: CurrentCaller) -> PreviewOut:
    """Return the first lines of a table that could not be read, screened for identity, so that its columns can be named."""
    return preview_out(service.waiting_table(db, file_id, caller))


@router.put("/uploaded-files/{file_id}/mapping", responses=problems(409))
def read_by_mapping(file_id: RowId, wanted: MappingIn, db: Db, caller: CurrentCaller) -> MappedOut:
    """Say what the columns of a waiting table are. It is read at once; where that fails nothing is stored, and the answer says why.

    The mapping is kept for the study: later tables with the same header are read by it without a question.
    """
    return applied_out(service.read_by(db, file_id, wanted, caller))


@router.get("/studies/{study_code}/column-mappings")
def list_mappings(study_code: str, db: Db, caller: CurrentCaller) -> list[MappingOut]:
    """List every version of a study's column mappings, newest first."""
    study = repository.study_of(db, study_code, caller)
    return mappings_out(repository.versions(db, study.id), repository.present(db, study.id))


@router.post("/column-mappings/{mapping_id}/removal", responses=problems(409))
def remove_mapping(mapping_id: RowId, wanted: RemovalIn, db: Db, caller: CurrentCaller) -> MappingOut:
    """End a mapping: what was read by it stays; the next table with its header waits for a new one."""
    row = service.remove(db, mapping_id, wanted.reason, caller)
    return mapping_out(row, False)
