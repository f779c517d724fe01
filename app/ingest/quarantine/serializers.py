"""Quarantined files as API types and downloads."""

from __future__ import annotations

from fastapi import Response

from app.ingest.models import UploadFile
from app.ingest.schemas import QuarantinedOut
from app.ingest.uploads import service


def original(content: bytes, file_id: int) -> Response:
    """Bytes for a person to look at; no browser may run them."""
    headers = {
        "Content-Disposition": f'attachment; filename="file-{file_id}.bin"',
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }
    return Response(content, media_type="application/octet-stream", headers=headers)


def problem_of(file: UploadFile) -> str:
    """Why a file could not be read, in the words that may be stored."""
    reports = service.stored_reports(file)
    found = [f"{r.problem.what} ({r.problem.where})" for r in reports if r.problem]
    return "; ".join(found or [s for r in reports for s in r.flagged if s.startswith("kept encrypted")])


def quarantined_out(file: UploadFile) -> QuarantinedOut:
    """A quarantined file for the API."""
    return QuarantinedOut(
        id=file.id,
        upload_id=file.upload_id,
        kind=file.kind,
        size=file.size,
        sha256=file.original_sha256,
        status=file.status,
        held=file.quarantine_sha256 is not None,
        problem=problem_of(file),
        reviewed_by=file.reviewed_by,
        reviewed_at=file.reviewed_at,
        decided_by=file.decided_by,
        decided_at=file.decided_at,
        decision_reason=file.decision_reason,
    )
