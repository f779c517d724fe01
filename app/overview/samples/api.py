"""The samples of a session to download, from its page and over REST."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, BinaryIO

from fastapi import APIRouter, Query
from fastapi.responses import StreamingResponse

from app.accounts.deps import CurrentCaller
from app.overview.samples.service import MEDIA_TYPES, SampleFormat, session_samples
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentSession

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))
CHUNK = 1 << 18

ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"content": {media: {"schema": {"type": "string", "format": "binary"}} for media in MEDIA_TYPES.values()}},
    **problems(409),
}
Form = Annotated[SampleFormat, Query(alias="format", description="Parquet: a row per sample. NWB 2: needs the extra `nwb`.")]


@router.get("/sessions/{session_id}/samples", response_class=StreamingResponse, responses=ANSWERS)
def read_samples(session: CurrentSession, db: Db, caller: CurrentCaller, form: Form = SampleFormat.PARQUET) -> StreamingResponse:
    """Every sample of a session's recordings with its time from the session's start, and every 2 s trace, as one file."""
    found = session_samples(db, session, form, caller)
    headers = {"Content-Disposition": f'attachment; filename="{found.name}"', "Content-Length": str(found.size)}
    return StreamingResponse(_chunks(found.content), media_type=MEDIA_TYPES[form], headers=headers)


def _chunks(content: BinaryIO) -> Iterator[bytes]:
    with content:
        while chunk := content.read(CHUNK):
            yield chunk
