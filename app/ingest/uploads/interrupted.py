"""Uploads that a stop of the service cut short, resumed from the bytes that were stored."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from threading import Event

import structlog
from sqlalchemy.orm import Session

from app.ingest import wording
from app.ingest.sessions import StatedSession
from app.ingest.stated_beta import BetaStated, decode_options
from app.ingest.uploads import service
from app.ingest.uploads.in_progress import in_progress, interrupted
from app.ingest.uploads.receiving import Receiver
from app.ingest.uploads.service import UploadOutcome
from app.platform.database import transaction
from app.platform.errors import Conflict, Invalid
from app.platform.jobs.children.child import places
from app.study import access
from app.tables.participants import Participant
from app.tables.uploads import Upload

log = structlog.get_logger()

RESUME_EVERY_S = 20.0


@dataclass(frozen=True)
class ResumedUpload:
    """An upload that was interrupted; what became of it; whether that worked, or was left for its participant, site or study."""

    upload_id: int
    message: str
    done: bool
    left: bool = False


def resume(actor: str) -> Iterator[ResumedUpload]:
    """Read the kept files of interrupted uploads and make or propose their sessions, each upload by itself; yields as it goes.

    Those of participants who have withdrawn, and of sites and studies that have ended, are left as they are. A file of which not all bytes
    had come is not there: its sender saw the upload fail, and sends it again.

    Args:
        actor: name for the audit trail.
    """
    with transaction(actor) as db:
        found = interrupted(db)
    for upload_id in found:
        try:
            with in_progress(upload_id), transaction(actor) as db:
                resumed = _resume(db, upload_id)
        except Exception as fault:
            # one upload that cannot be read must not keep the others from being resumed; it stays as it is
            log.error("interrupted upload could not be resumed", upload=upload_id, places=places(fault))
            resumed = ResumedUpload(upload_id, f"it could not be resumed: {type(fault).__name__}, see the log", False)
        yield resumed


def keep_resuming(actor: str, stop: Event, every_s: float = RESUME_EVERY_S) -> None:
    """Resume interrupted uploads now, and again until `stop` is set: a fault of ours cuts uploads short without a restart too."""
    while True:
        try:
            for taken in resume(actor):
                if not taken.left:  # each minute, for as long as the study has ended
                    log.info("interrupted upload", upload=taken.upload_id, done=taken.done, message=taken.message)
        except Exception as fault:
            # the database may be away; uploads wait until it is back
            log.error("interrupted uploads could not be looked for", places=places(fault))
        if stop.wait(every_s):
            return


def why_left(participant: Participant) -> str | None:
    """Explain why an upload of the participant that was cut short is not read, in a sentence; None where it is.

    Participants who have withdrawn, sites and studies that have ended get no new data, not those either whose bytes came before.
    """
    try:
        access.refuse_withdrawn(participant)
        access.refuse_ended(participant.site)
    except Conflict as refused:
        return refused.detail
    return None


def _resume(db: Session, upload_id: int) -> ResumedUpload:
    upload = db.get_one(Upload, upload_id)
    if upload.status != "received":
        return ResumedUpload(upload_id, "it was finished meanwhile", True)
    participant, said = db.get_one(Participant, upload.participant_id), upload.stated
    if why := why_left(participant):
        return ResumedUpload(upload_id, wording.left(why), False, left=True)
    beta = BetaStated(said.get("unit"), said.get("source"), said.get("lfp_unit"))
    receiver = Receiver(db, participant, upload, decode_options(db, participant, beta), beta)
    outcome = UploadOutcome(upload, participant, [receiver.resume(row) for row in list(upload.files)])
    try:
        stated = service.as_stated(db, participant, said)
    except Invalid:
        stated = StatedSession()  # the visit or policy that was stated is gone: a person says which
    service.finish(db, outcome, stated)
    listed = ", ".join(map(str, outcome.session_ids)) or "none"
    return ResumedUpload(upload_id, f"files: {len(outcome.files)}, sessions: {listed}", True)
