"""Every query of uploads."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload, selectinload

from app.accounts.policy import Caller
from app.ingest.models import Upload, UploadFile
from app.platform.errors import NotFound
from app.study.models import Device, Participant, Recording, SessionSegment
from app.study.repository import in_scope


def lock_participant(db: Session, participant_id: int) -> None:
    """Let one upload of a participant at a time make recordings and sessions; held to the end of the transaction."""
    db.execute(select(Participant.id).where(Participant.id == participant_id).with_for_update())


def decoded_file(db: Session, participant_id: int, sha256: str) -> UploadFile | None:
    """The participant's file of these original bytes, if it was decoded before."""
    return db.scalar(
        select(UploadFile).where(
            UploadFile.participant_id == participant_id, UploadFile.original_sha256 == sha256, UploadFile.status == "decoded"
        )
    )


def session_ids_of_file(db: Session, upload_file_id: int) -> Sequence[int]:
    """Sessions that the recordings of a file belong to."""
    return db.scalars(
        select(SessionSegment.session_id)
        .join(Recording, Recording.id == SessionSegment.recording_id)
        .where(Recording.upload_file_id == upload_file_id)
        .distinct()
        .order_by(SessionSegment.session_id)
    ).all()


def device(db: Session, participant_id: int, pseudonym: str) -> Device | None:
    """A participant's device."""
    return db.scalar(select(Device).where(Device.participant_id == participant_id, Device.pseudonym == pseudonym))


def upload(db: Session, upload_id: int, caller: Caller) -> tuple[Upload, Participant]:
    """An upload and its participant. Raises NotFound."""
    row = db.execute(
        select(Upload, Participant)
        .join(Participant, Participant.id == Upload.participant_id)
        .join(Participant.site)
        .where(Upload.id == upload_id, in_scope(caller))
        .options(selectinload(Upload.files), joinedload(Participant.site))
    ).first()
    if row is None:
        raise NotFound(f"There is no upload {upload_id}, or you have no access to it.")
    return row[0], row[1]


def uploads_of_participant(db: Session, participant_id: int, limit: int = 20) -> Sequence[Upload]:
    """A participant's uploads, newest first."""
    return db.scalars(
        select(Upload)
        .where(Upload.participant_id == participant_id)
        .order_by(Upload.id.desc())
        .limit(limit)
        .options(selectinload(Upload.files))
    ).all()
