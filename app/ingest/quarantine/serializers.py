"""Quarantined files as API types and downloads."""

from __future__ import annotations

from collections.abc import Iterator

from fastapi import Response
from fastapi.responses import StreamingResponse

from app.ingest import wording
from app.ingest.schemas import QuarantinedOut
from app.ingest.uploads import service
from app.tables.uploads import UploadFile


def original(content: Iterator[bytes], file_id: int) -> Response:
    """Send bytes for a person to look at; no browser may run them."""
    headers = {
        "Content-Disposition": f'attachment; filename="file-{file_id}.bin"',
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }
    return StreamingResponse(content, media_type="application/octet-stream", headers=headers)


def problem_of(file: UploadFile) -> str:
    """Explain why a file could not be read, in the words that may be stored."""
    reports = service.stored_reports(file)
    found = [f"{r.problem.what} ({r.problem.where})" for r in reports if r.problem]
    return "; ".join(found or wording.unreadable(service.unreadable_members(file)))


def quarantined_out(file: UploadFile) -> QuarantinedOut:
    """Convert a quarantined file for the API."""
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
