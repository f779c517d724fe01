"""REST routes of uploads."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, File, Form, UploadFile
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.ingest import repository
from app.ingest.proposals.serializers import proposal_out
from app.ingest.schemas import FileReportOut, UploadedFileOut, UploadOut
from app.ingest.uploads import service
from app.ingest.uploads.early_refusal import UploadRoute
from app.ingest.uploads.service import BetaStated, Incoming, UploadOutcome
from app.platform.database import Db
from app.platform.errors import Invalid
from app.platform.web.schemas import Moment, RowId, Text, problems
from app.study import repository as study
from app.study.routes.serializers import session_out
from app.study.settings_types import BetaSource
from app.tables.participants import Hemisphere
from app.tables.sessions import Controller
from app.tables.uploads import UploadFile as UploadFileRow
from ml.formats.tables.cells.numbers import unit_name

router = APIRouter(route_class=UploadRoute, tags=["uploads"], responses=problems(401, 403, 404, 422))


class UnusableUpload(Invalid):
    """Nothing in the upload could be used; the bytes are kept all the same."""

    title = "Nothing in this upload can be used"


@router.post("/uploads", status_code=201, responses=problems(409, 413, 429))
def upload(
    db: Db,
    caller: CurrentCaller,
    file: Annotated[
        list[UploadFile],
        File(
            description="Any number of files: RC+S session folders, Percept reports, tables (CSV, Parquet), StrivePD and grasp tables. "
            "A session folder is a zip or loose JSON files, bundled by the folder in their names."
        ),
    ],
    participant: Annotated[Text, Form(max_length=40, description="Code of the participant.")],
    visit: Annotated[int | None, Form(ge=1, le=2**31 - 1, description="Number of the visit; by default proposed by its date.")] = None,
    controller: Annotated[Controller | None, Form(description="What drove the stimulation; by default sessions are proposed.")] = None,
    policy: Annotated[Text | None, Form(max_length=100, description="Name or number of the policy that ran.")] = None,
    started_at: Annotated[Moment | None, Form(description="Start of the session; without an offset: UTC.")] = None,
    hemisphere: Annotated[Hemisphere | None, Form(description="Side of the controlled implant, where the file does not say.")] = None,
    beta_unit: Annotated[Text | None, Form(max_length=40, description="Unit of a table's beta; the participant's by default.")] = None,
    beta_source: Annotated[BetaSource | None, Form(description="Where a table's beta comes from; the participant's by default.")] = None,
    lfp_unit: Annotated[Text | None, Form(max_length=40, description="Unit of a table's LFP, where its header states none.")] = None,
    confirm: Annotated[bool, Form(description="Whether sessions with a stated controller count at once; false proposes them.")] = True,
    session: Annotated[int | None, Form(ge=1, le=2**31 - 1, description="Session of grasp files, which name no clock.")] = None,
) -> UploadOut:
    """Upload files of sessions. The answer comes after decoding; the same bytes again give the same sessions.

    With visit and controller stated the sessions count at once; otherwise they are proposals, to be confirmed or corrected.
    """
    person = study.participant_by_code(db, participant, caller)
    stated = service.state_session(db, person, visit, controller, policy, started_at, hemisphere, confirm, session)
    incoming = [Incoming(f.filename or "file", f.file) for f in file]
    beta = BetaStated(unit_name(beta_unit) if beta_unit else None, beta_source, lfp_unit or None)
    outcome = service.receive(db, person, stated, incoming, caller, beta)
    if not outcome.usable:
        raise unusable(outcome)
    return upload_out(db, outcome, caller)


@router.get("/uploads/{upload_id}")
def read_upload(upload_id: RowId, db: Db, caller: CurrentCaller) -> UploadOut:
    """Return one upload with its reports."""
    row, person = repository.upload(db, upload_id, caller)
    return upload_out(db, UploadOutcome(row, person, service.stored_outcomes(db, row)), caller)


def unusable(outcome: UploadOutcome) -> UnusableUpload:
    """Build the problem document of an upload of which nothing can be used: the first file, the place, the hint; and every report."""
    first = next((r for r in outcome.reports_for_sender if r.problem), None)
    reports = [FileReportOut.model_validate(r).model_dump() for r in outcome.reports_for_sender]
    if first is None or first.problem is None:
        return UnusableUpload("No file in this upload holds a recording.", "Choose the files of a session.", report=reports)
    # the report on several files together (two recordings' loose files) comes before the first file's own problem
    together = [sentence for aside in outcome.asides for sentence in aside.flagged]
    kept = any(f.row.stored_sha256 for f in outcome.files if f.name == first.name)
    what = f"{first.name}: {first.problem.what} ({first.problem.where}). {'The file is kept.' if kept else 'Nothing of it was kept.'}"
    return UnusableUpload(
        " ".join([*together, what]),
        first.problem.hint,
        file=first.name,
        where=first.problem.where,
        upload_id=outcome.upload.id,
        sha256=outcome.files[0].row.original_sha256,
        waits_for_mapping=[f.row.id for f in outcome.files if f.row.preview is not None],
        report=reports,
    )


def upload_out(db: Session, outcome: UploadOutcome, caller: Caller) -> UploadOut:
    """Convert an upload for the API."""
    sessions = [study.session(db, i, caller) for i in outcome.session_ids]
    behind = repository.proposals(db, [s.id for s in sessions if s.status == "proposed"])
    return UploadOut(
        id=outcome.upload.id,
        sha256=outcome.files[0].row.original_sha256 if outcome.files else None,
        duplicate=bool(outcome.files) and all(f.duplicate for f in outcome.files),
        participant=outcome.participant.code,
        status=outcome.upload.status,
        created_at=outcome.upload.created_at,
        created_by=outcome.upload.created_by,
        sessions=[session_out(s, caller) for s in sessions],
        proposals=[proposal_out(db, s, behind[s.id], caller) for s in sessions if s.id in behind],
        files=[_file_out(f.name, f.row, f.duplicate, f.session_ids) for f in outcome.files],
        report=[FileReportOut.model_validate(r) for r in outcome.reports_for_sender],
    )


def _file_out(name: str, row: UploadFileRow, duplicate: bool, session_ids: list[int]) -> UploadedFileOut:
    return UploadedFileOut(
        id=row.id,
        name=name,
        kind=row.kind,
        size=row.size,
        sha256=row.original_sha256,
        stored_sha256=row.stored_sha256,
        redactor_version=row.redactor_version,
        quarantined=row.quarantine_sha256 is not None,
        status=row.status,
        waits_for_mapping=row.preview is not None,
        duplicate=duplicate,
        session_ids=session_ids,
    )
