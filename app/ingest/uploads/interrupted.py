"""Uploads that a stop of the service cut short, taken up from the bytes that were kept."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import structlog
from sqlalchemy.orm import Session

from app.ingest.models import Upload
from app.ingest.sessions import StatedSession
from app.ingest.uploads import service
from app.ingest.uploads.in_progress import in_progress, interrupted
from app.ingest.uploads.receiving import BetaStated, Receiver
from app.ingest.uploads.service import UploadOutcome
from app.platform.database import transaction
from app.platform.errors import Invalid
from app.study.models import Participant

log = structlog.get_logger()


@dataclass(frozen=True)
class TakenUp:
    """An upload that was interrupted; what became of it, in words; whether that worked."""

    upload_id: int
    said: str
    done: bool


def take_up(actor: str) -> Iterator[TakenUp]:
    """Read the kept files of interrupted uploads and make or propose their sessions, each upload by itself; yields as it goes.

    A file of which not all bytes had come is not there: its sender saw the upload fail, and sends it again.

    Args:
        actor: who stands in the audit trail.
    """
    with transaction(actor) as db:
        found = interrupted(db)
    for upload_id in found:
        try:
            with in_progress(upload_id), transaction(actor) as db:
                taken = TakenUp(upload_id, _take_up(db, upload_id), True)
        except Exception as fault:
            # one upload that cannot be read must not keep the others from being taken up; it stays as it is
            log.exception("interrupted upload could not be taken up", upload=upload_id, fault=repr(fault))
            taken = TakenUp(upload_id, f"it could not be taken up: {fault}", False)
        yield taken


def _take_up(db: Session, upload_id: int) -> str:
    upload = db.get_one(Upload, upload_id)
    if upload.status != "received":
        return "it was finished meanwhile"
    participant, said = db.get_one(Participant, upload.participant_id), upload.stated
    beta = BetaStated(said.get("unit"), said.get("source"), said.get("lfp_unit"))
    receiver = Receiver(db, participant, upload, service.decode_options(participant, beta), beta)
    outcome = UploadOutcome(upload, participant, [receiver.take_up(row) for row in list(upload.files)])
    try:
        stated = service.as_stated(db, participant, said)
    except Invalid:
        stated = StatedSession()  # the visit or policy that was stated is gone: a person says which
    service.finish(db, outcome, stated)
    listed = ", ".join(map(str, outcome.session_ids)) or "none"
    return f"files: {len(outcome.files)}, sessions: {listed}"
