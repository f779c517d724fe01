"""Every query of uploads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import func, or_, select, text, true
from sqlalchemy.orm import Session, joinedload, selectinload

from app.accounts.permissions import Caller
from app.platform.errors import NotFound
from app.study.repository import in_scope
from app.study.sessions.repository import SLACK_S
from app.tables.participants import Participant
from app.tables.recordings import Device, Recording
from app.tables.sessions import SessionSegment, StudySession
from app.tables.uploads import SessionProposal, SignalMeaning, Upload, UploadFile
from app.tables.visits import Visit

GRASP_KIND = "grasp"
"""Kind of a file with hand-grasp tests, which names no clock."""


def lock_participant(db: Session, participant_id: int) -> None:
    """Let one upload of a participant at a time make recordings and sessions; locked to the end of the transaction."""
    db.execute(select(Participant.id).where(Participant.id == participant_id).with_for_update())


def decoded_file(db: Session, participant_id: int, sha256: str) -> UploadFile | None:
    """Find the participant's file of these original bytes, if it was decoded before."""
    return db.scalar(
        select(UploadFile).where(
            UploadFile.participant_id == participant_id, UploadFile.original_sha256 == sha256, UploadFile.status == "decoded"
        )
    )


def failed_file(db: Session, participant_id: int, file: UploadFile) -> UploadFile | None:
    """Find the participant's earlier file of the same original bytes that could not be used either, and that awaits a decision."""
    same = (UploadFile.original_sha256 == file.original_sha256) & (UploadFile.id < file.id) & (UploadFile.status == "failed")
    sealed = UploadFile.quarantine_sha256.is_not(None) if file.quarantine_sha256 else UploadFile.quarantine_sha256.is_(None)
    query = select(UploadFile).where(UploadFile.participant_id == participant_id, same, sealed, UploadFile.decided_at.is_(None))
    return db.scalar(query.order_by(UploadFile.id).limit(1))


def refused_file(db: Session, participant_id: int, sha256: str) -> UploadFile | None:
    """Find the participant's file of these original bytes that could not be used, and that awaits a decision."""
    same = (UploadFile.participant_id == participant_id) & (UploadFile.original_sha256 == sha256) & (UploadFile.status == "failed")
    return db.scalar(select(UploadFile).where(same, UploadFile.decided_at.is_(None)).order_by(UploadFile.id).limit(1))


def names_stored(db: Session, sha256: str) -> bool:
    """Decide whether any uploaded file has these stored bytes, cleaned, encrypted or released."""
    columns = (UploadFile.stored_sha256, UploadFile.quarantine_sha256, UploadFile.released_sha256)
    return db.scalar(select(UploadFile.id).where(or_(*(column == sha256 for column in columns))).limit(1)) is not None


def session_ids_of_file(db: Session, file: UploadFile, known_recordings: Sequence[int] = ()) -> list[int]:
    """List the sessions that the recordings of a file belong to, or that the file was attached to.

    Args:
        known_recordings: recordings of the file that another file had brought before.
    """
    mine = (Recording.upload_file_id == file.id) | Recording.id.in_(known_recordings)
    query = select(SessionSegment.session_id).join(Recording, Recording.id == SessionSegment.recording_id).where(mine)
    attached = {file.session_id} if file.session_id is not None else set()
    return sorted({*db.scalars(query.distinct()), *attached})


def device(db: Session, participant_id: int, pseudonym: str) -> Device | None:
    """Find a participant's device."""
    return db.scalar(select(Device).where(Device.participant_id == participant_id, Device.pseudonym == pseudonym))


def next_upload(db: Session) -> int:
    """Draw the number of a new upload, before there is a row."""
    number: int = db.scalars(select(func.nextval("upload_id_seq"))).one()
    return number


def upload(db: Session, upload_id: int, caller: Caller) -> tuple[Upload, Participant]:
    """Find an upload and its participant. Raises NotFound."""
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
    """List a participant's uploads, newest first."""
    return db.scalars(
        select(Upload)
        .where(Upload.participant_id == participant_id)
        .order_by(Upload.id.desc())
        .limit(limit)
        .options(selectinload(Upload.files))
    ).all()


def unfinished_uploads(db: Session) -> Sequence[int]:
    """List the numbers of the uploads that were begun and not finished, oldest first."""
    return db.scalars(select(Upload.id).where(Upload.status == "received").order_by(Upload.id)).all()


def received_uploads(db: Session, participant_id: int) -> Sequence[int]:
    """List the numbers of a participant's uploads that were begun and not finished, oldest first."""
    mine = (Upload.participant_id == participant_id) & (Upload.status == "received")
    return db.scalars(select(Upload.id).where(mine).order_by(Upload.id)).all()


def file_of_recording(db: Session, recording: Recording) -> UploadFile:
    """Find the file that gave a recording, which has one."""
    return db.get_one(UploadFile, recording.upload_file_id)


def recordings_of_file(db: Session, upload_file_id: int) -> Sequence[Recording]:
    """List the recordings that a file gave, in the order in which they were stored."""
    return db.scalars(select(Recording).where(Recording.upload_file_id == upload_file_id).order_by(Recording.id)).all()


def recordings_by_id(db: Session, ids: Sequence[int]) -> Sequence[Recording]:
    """Find recordings by number."""
    return db.scalars(select(Recording).where(Recording.id.in_(ids)).order_by(Recording.id)).all() if ids else []


def recordings_of_minutes(db: Session, like: Recording) -> Sequence[Recording]:
    """List recordings of the device and side of another one that share minutes with it and were not superseded, oldest first.

    Recordings without a known start share no minutes with any other.

    Args:
        like: it need not be stored; one of no known side is of both.
    """
    assert like.started_at is not None
    either = true() if like.hemisphere is None else Recording.hemisphere.is_(None) | (Recording.hemisphere == like.hemisphere)
    last = Recording.started_at + func.make_interval(0, 0, 0, 0, 0, 0, Recording.duration_s)
    end = like.started_at + timedelta(seconds=like.duration_s)
    shared = func.extract("epoch", func.least(last, end) - func.greatest(Recording.started_at, like.started_at))
    own = (Recording.device_id == like.device_id) & Recording.superseded_by_id.is_(None)
    # LEAST and GREATEST ignore NULL, so that a recording without a start would share all minutes
    dated = Recording.started_at.is_not(None)
    return db.scalars(select(Recording).where(own, dated, either, shared > SLACK_S).order_by(Recording.id)).all()


def unknown_names(db: Session) -> Sequence[tuple[str, str, int, int, datetime]]:
    """List the technical names in devices' files that their decoders do not know, those of the most recordings first.

    Returns:
        Kind of the device, name, number of recordings and of devices, and when the last of them arrived.
    """
    stored = Recording.details["settings"]["unknown_names"]
    each = func.jsonb_array_elements_text(stored).table_valued("value")
    name, count = each.c.value, func.count(Recording.id.distinct())
    query = (
        select(UploadFile.kind, name, count, func.count(Recording.device_id.distinct()), func.max(Upload.created_at))
        .join(UploadFile, UploadFile.id == Recording.upload_file_id)
        .join(Upload, Upload.id == UploadFile.upload_id)
        .join(each, true())
        .where(func.jsonb_typeof(stored) == "array")
        .group_by(UploadFile.kind, name)
        .order_by(count.desc(), UploadFile.kind, name)
    )
    return [(row[0], row[1], row[2], row[3], row[4]) for row in db.execute(query)]


def fullest(db: Session, recordings: Sequence[Recording]) -> list[Recording]:
    """Replace recordings by the fuller copies that superseded them, each once."""
    found: dict[int, Recording] = {}
    for recording in recordings:
        while recording.superseded_by_id is not None:
            recording = db.get_one(Recording, recording.superseded_by_id)
        found[recording.id] = recording
    return list(found.values())


def confirmed_sessions_of_recording(db: Session, recording_id: int, besides: int) -> Sequence[int]:
    """List the confirmed sessions that count on a recording, other than the one named."""
    query = select(StudySession.id).join(SessionSegment, SessionSegment.session_id == StudySession.id)
    mine = (SessionSegment.recording_id == recording_id) & (StudySession.id != besides)
    return db.scalars(query.where(mine, StudySession.status == "confirmed").distinct()).all()


def segments_of_recording(db: Session, recording_id: int, besides: int) -> Sequence[SessionSegment]:
    """List the parts of a recording that belong to sessions, other than the one named."""
    query = select(SessionSegment).where(SessionSegment.recording_id == recording_id, SessionSegment.session_id != besides)
    return db.scalars(query.options(joinedload(SessionSegment.session)).order_by(SessionSegment.start_s)).all()


def proposal(db: Session, session_id: int, caller: Caller, lock: bool = False) -> SessionProposal:
    """Find the proposal behind a session; `lock`: no other may change it until the transaction ends. Raises NotFound."""
    query = (
        select(SessionProposal)
        .join(StudySession, StudySession.id == SessionProposal.session_id)
        .join(StudySession.visit)
        .join(Visit.participant)
        .join(Participant.site)
        .where(SessionProposal.session_id == session_id, in_scope(caller))
    )
    row = db.scalar(query.with_for_update(of=SessionProposal).execution_options(populate_existing=True) if lock else query)
    if row is None:
        raise NotFound(f"There is no proposed session {session_id}, or you have no access to it.")
    return row


def proposals(db: Session, session_ids: Sequence[int]) -> dict[int, SessionProposal]:
    """Map sessions to their proposals."""
    return {p.session_id: p for p in db.scalars(select(SessionProposal).where(SessionProposal.session_id.in_(session_ids)))}


def overlapping_sessions(db: Session, participant_id: int, begin: datetime, end: datetime) -> Sequence[StudySession]:
    """List a participant's sessions, proposed ones too, with a start before `end`, newest first, that may share time with [begin, end]."""
    query = select(StudySession).join(StudySession.visit).where(Visit.participant_id == participant_id)
    near = StudySession.started_at.between(begin - timedelta(days=1), end)
    return db.scalars(query.where(near).order_by(StudySession.id.desc())).all()


def waiting_grasp_files(db: Session, participant_id: int) -> Sequence[UploadFile]:
    """List decoded grasp files that no session has yet, oldest first."""
    mine = (UploadFile.participant_id == participant_id) & (UploadFile.kind == GRASP_KIND)
    query = select(UploadFile).where(mine, UploadFile.status == "decoded", UploadFile.session_id.is_(None))
    return db.scalars(query.order_by(UploadFile.id)).all()


def upload_file(db: Session, file_id: int, caller: Caller, lock: bool = False) -> tuple[UploadFile, Participant]:
    """Find a file of an upload and its participant; `lock`: no other may change it until the transaction ends. Raises NotFound."""
    query = (
        select(UploadFile, Participant)
        .join(Participant, Participant.id == UploadFile.participant_id)
        .join(Participant.site)
        .where(UploadFile.id == file_id, in_scope(caller))
    )
    row = db.execute(query.with_for_update(of=UploadFile).execution_options(populate_existing=True) if lock else query).first()
    if row is None:
        raise NotFound(f"There is no uploaded file {file_id}, or you have no access to it.")
    return row[0], row[1]


def files_of_upload(db: Session, upload_id: int) -> Sequence[UploadFile]:
    """List the files of an upload in the order in which they came."""
    return db.scalars(select(UploadFile).where(UploadFile.upload_id == upload_id).order_by(UploadFile.id)).all()


def quarantined_files(db: Session, participant_id: int) -> Sequence[UploadFile]:
    """List files that are, or were, stored encrypted because they could not be read, newest first."""
    touched = UploadFile.quarantine_sha256.is_not(None) | UploadFile.decided_at.is_not(None)
    return db.scalars(select(UploadFile).where(UploadFile.participant_id == participant_id, touched).order_by(UploadFile.id.desc())).all()


def readable_files(db: Session, participant_id: int | None, upload_file_id: int | None) -> Sequence[int]:
    """List the numbers of the decoded files, of one participant or one file where named, oldest first."""
    query = select(UploadFile.id).where(UploadFile.status == "decoded", UploadFile.stored_sha256.is_not(None))
    if participant_id is not None:
        query = query.where(UploadFile.participant_id == participant_id)
    if upload_file_id is not None:
        query = query.where(UploadFile.id == upload_file_id)
    return db.scalars(query.order_by(UploadFile.id)).all()


def defer_counting(db: Session, deferred: bool) -> None:
    """Let minutes count twice until this is called again with False, which raises IntegrityError where they still do."""
    db.execute(text(f"set constraints counted_time_once {'deferred' if deferred else 'immediate'}"))


def meanings(db: Session, study_id: int) -> dict[str, SignalMeaning]:
    """Find the newest version of each meaning of markers and channels in a study, by its key, removed ones too."""
    rows = db.scalars(select(SignalMeaning).where(SignalMeaning.study_id == study_id).order_by(SignalMeaning.version)).all()
    return {row.key: row for row in rows}


def meanings_in_force(db: Session, study_id: int) -> dict[str, Mapping[str, Any]]:
    """Collect the meanings of markers and channels by which recordings of a study are read, by their keys."""
    return {key: row.meaning for key, row in meanings(db, study_id).items() if not row.removed}


def lock_meanings(db: Session, study_id: int) -> None:
    """Let others who state meanings in the study wait until the transaction ends."""
    db.execute(select(func.pg_advisory_xact_lock(func.hashtext("signal_meaning"), study_id)))


def sessions_of_file(db: Session, file_id: int) -> Sequence[StudySession]:
    """List the sessions that use a recording of a file."""
    of_file = select(Recording.id).where(Recording.upload_file_id == file_id)
    used = select(SessionSegment.session_id).where(SessionSegment.recording_id.in_(of_file))
    return db.scalars(select(StudySession).where(StudySession.id.in_(used)).order_by(StudySession.id)).all()
