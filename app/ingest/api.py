"""REST routes of uploads."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, File, Form, UploadFile
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.accounts.policy import Caller
from app.ingest import repository, service
from app.ingest.formats.numbers import unit_name
from app.ingest.models import UploadFile as UploadFileRow
from app.ingest.schemas import FileReportOut, UploadedFileOut, UploadOut
from app.ingest.service import BetaStated, Incoming, UploadOutcome
from app.platform.database import Db
from app.platform.errors import Invalid
from app.platform.schemas import Moment, RowId, Text, problems
from app.study import repository as study
from app.study.api import session_out
from app.study.models import Controller, Hemisphere
from app.study.schemas import BetaSource

router = APIRouter(tags=["uploads"], responses=problems(401, 403, 404, 422))


class UnusableUpload(Invalid):
    """Nothing in the upload could be used; the bytes are kept all the same."""

    title = "Nothing in this upload can be used"


@router.post("/uploads", status_code=201, responses=problems(413))
def upload(
    db: Db,
    caller: CurrentCaller,
    file: Annotated[list[UploadFile], File(description="One or more files: an RC+S session folder as zip, or a table (CSV, Parquet).")],
    participant: Annotated[Text, Form(max_length=40, description="Code of the participant.")],
    visit: Annotated[int, Form(ge=1, le=2**31 - 1, description="Number of the visit.")],
    controller: Annotated[Controller, Form(description="What drove the stimulation.")],
    policy: Annotated[Text | None, Form(max_length=100, description="Name or number of the policy that ran.")] = None,
    started_at: Annotated[Moment | None, Form(description="Start of the session; without an offset: UTC.")] = None,
    hemisphere: Annotated[Hemisphere | None, Form(description="Side of the controlled implant, where the file does not tell.")] = None,
    beta_unit: Annotated[Text | None, Form(max_length=40, description="Unit of a table's beta; the participant's when left out.")] = None,
    beta_source: Annotated[BetaSource | None, Form(description="Where a table's beta comes from; the participant's when left out.")] = None,
) -> UploadOut:
    """Upload the files of one session. The answer comes after decoding; the same bytes again give the same sessions."""
    person = study.participant_by_code(db, participant, caller)
    stated = service.state_session(db, person, visit, controller, policy, started_at, hemisphere)
    incoming = [Incoming(f.filename or "file", f.file) for f in file]
    outcome = service.receive(db, person, stated, incoming, caller, BetaStated(unit_name(beta_unit) if beta_unit else None, beta_source))
    if not outcome.usable:
        raise unusable(outcome)
    return upload_out(db, outcome, caller)


@router.get("/uploads/{upload_id}")
def read_upload(upload_id: RowId, db: Db, caller: CurrentCaller) -> UploadOut:
    """One upload with its reports."""
    row, person = repository.upload(db, upload_id, caller)
    return upload_out(db, UploadOutcome(row, person, service.stored_outcomes(db, row)), caller)


def unusable(outcome: UploadOutcome) -> UnusableUpload:
    """The problem document of an upload of which nothing can be used: the first file, the place, the mend; and every report."""
    first = next(r for f in outcome.files for r in f.reports_for_sender if r.problem)
    assert first.problem is not None
    return UnusableUpload(
        f"{first.name}: {first.problem.what} ({first.problem.where}). The file is kept.",
        first.problem.mend,
        file=first.name,
        where=first.problem.where,
        upload_id=outcome.upload.id,
        sha256=outcome.files[0].row.original_sha256,
        report=[FileReportOut.model_validate(r).model_dump() for f in outcome.files for r in f.reports_for_sender],
    )


def upload_out(db: Session, outcome: UploadOutcome, caller: Caller) -> UploadOut:
    """An upload for the API."""
    first = outcome.files[0]
    return UploadOut(
        id=outcome.upload.id,
        sha256=first.row.original_sha256,
        duplicate=all(f.duplicate for f in outcome.files),
        participant=outcome.participant.code,
        status=outcome.upload.status,
        created_at=outcome.upload.created_at,
        created_by=outcome.upload.created_by,
        sessions=[session_out(study.session(db, i, caller), caller) for i in outcome.session_ids],
        files=[_file_out(f.name, f.row, f.duplicate, f.session_ids) for f in outcome.files],
        report=[FileReportOut.model_validate(r) for f in outcome.files for r in f.reports_for_sender],
    )


def _file_out(name: str, row: UploadFileRow, duplicate: bool, session_ids: list[int]) -> UploadedFileOut:
    return UploadedFileOut(
        name=name,
        kind=row.kind,
        size=row.size,
        sha256=row.original_sha256,
        stored_sha256=row.stored_sha256,
        status=row.status,
        duplicate=duplicate,
        session_ids=session_ids,
    )
