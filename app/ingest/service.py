"""Rules of uploads: bytes first, then identity out, then recordings and sessions; the same bytes twice are one recording.

The caller commits nothing: an upload has two commits of its own, one when the bytes are safe and one when they are decoded, so that a
crash between them loses nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

from sqlalchemy.orm import Session

from app.accounts import policy as can
from app.accounts.policy import Caller
from app.ingest import formats, quarantine, repository, sessions
from app.ingest.formats.log import FileReport, Problem, UndecodableFile
from app.ingest.formats.options import ArchiveLimits, DecodeOptions
from app.ingest.models import Upload, UploadFile
from app.ingest.sessions import StatedSession
from app.platform import files
from app.platform.errors import Invalid, TooLarge
from app.settings import get_settings
from app.study import repository as study
from app.study import service as study_service
from app.study.models import Controller, Participant

REDACTOR_VERSION = 1


@dataclass(frozen=True)
class Incoming:
    """One file as it arrives."""

    name: str
    stream: BinaryIO


@dataclass
class FileOutcome:
    """What became of one file. `name` is what the sender called it: told back to the sender, never stored."""

    name: str
    row: UploadFile
    reports: list[FileReport]
    duplicate: bool = False
    session_ids: list[int] = field(default_factory=list)

    @property
    def reports_for_sender(self) -> list[FileReport]:
        """The reports, naming the file as the sender does."""
        return [replace(r, name=self.name) if r.name == self.row.name else r for r in self.reports]


@dataclass
class UploadOutcome:
    """What became of an upload."""

    upload: Upload
    participant: Participant
    files: list[FileOutcome]

    @property
    def session_ids(self) -> list[int]:
        """Sessions of all files, each once."""
        return sorted({i for f in self.files for i in f.session_ids})

    @property
    def usable(self) -> bool:
        """Whether anything could be used."""
        return any(f.row.status == "decoded" for f in self.files)


def state_session(
    db: Session,
    participant: Participant,
    visit_number: int,
    controller: Controller,
    policy: str | None,
    started_at: datetime | None,
) -> StatedSession:
    """What the sender says of the session. Raises Invalid for a visit or policy that does not exist."""
    visit = study.visit_by_number(db, participant.id, visit_number)
    if visit is None:
        known = ", ".join(str(v.number) for v in study.visits(db, participant.id, 500, 0)[0]) or "none yet"
        raise Invalid(f"Participant {participant.code} has no visit {visit_number} (visits: {known}).", "Add the visit first.")
    policy_id = None
    if policy:
        policy_id = study.policy_id(db, participant.id, policy)
        if policy_id is None:
            raise Invalid(f"Participant {participant.code} has no policy '{policy}'.", "Give the name or number of one of its policies.")
    return StatedSession(visit=visit, controller=controller, policy_id=policy_id, started_at=started_at)


def receive(
    db: Session,
    participant: Participant,
    stated: StatedSession,
    incoming: Sequence[Incoming],
    caller: Caller,
    beta_unit: str | None = None,
) -> UploadOutcome:
    """Take an upload: keep every file, decode what can be decoded, make sessions.

    Raises:
        TooLarge: a file exceeds the installation's limit; files before it are kept.
    """
    study_service.require(caller, can.UPLOAD, participant)
    if not incoming:
        raise Invalid("The upload holds no file.", "Choose at least one file.")
    upload = Upload(
        participant_id=participant.id,
        visit_id=stated.visit.id,
        created_by=caller.label,
        report=[],
        stated={
            "visit": stated.visit.number,
            "controller": stated.controller,
            "policy_id": stated.policy_id,
            "started_at": stated.started_at.isoformat() if stated.started_at else None,
            "beta_unit": beta_unit,
        },
    )
    db.add(upload)
    db.flush()
    options = decode_options(participant, beta_unit)
    outcomes = [_receive_file(db, participant, upload, stated, one, options) for one in incoming]
    upload.report = [asdict(r) for o in outcomes for r in o.reports]
    upload.status = "decoded" if any(o.row.status == "decoded" for o in outcomes) else "failed"
    db.commit()
    return UploadOutcome(upload, participant, outcomes)


def decode_options(participant: Participant, beta_unit: str | None = None) -> DecodeOptions:
    """The participant's choices for decoders."""
    settings = participant.current_settings
    return DecodeOptions(
        period_s=settings.period_s,
        beta_low_hz=settings.beta_low_hz,
        beta_high_hz=settings.beta_high_hz,
        min_valid_fraction=settings.min_valid_fraction,
        table_beta_unit=beta_unit or settings.beta_unit or "unstated",
        archive=ArchiveLimits(),
    )


def _receive_file(
    db: Session, participant: Participant, upload: Upload, stated: StatedSession, one: Incoming, options: DecodeOptions
) -> FileOutcome:
    limit = get_settings().upload_limit_mb * 1024 * 1024
    name = Path(one.name.replace("\\", "/")).name[:255] or "file"
    try:
        draft, sha256, size = files.receive(one.stream, limit)
    except OverflowError as error:
        raise TooLarge(
            f"'{name}' is larger than {get_settings().upload_limit_mb} MiB.",
            "Split it, or have BETALOOP_UPLOAD_LIMIT_MB raised.",
        ) from error
    try:
        known = _known(db, participant, stated, name, sha256)
        return known or _keep_and_decode(db, participant, upload, stated, name, draft, sha256, size, options)
    finally:
        draft.unlink(missing_ok=True)


def _known(db: Session, participant: Participant, stated: StatedSession, name: str, sha256: str) -> FileOutcome | None:
    """The outcome for bytes that were decoded before: the same sessions, and nothing changed."""
    row = repository.decoded_file(db, participant.id, sha256)
    if row is None:
        return None
    ids = list(repository.session_ids_of_file(db, row.id))
    note = f"The same bytes came before, as '{row.name}' in upload {row.upload_id}; nothing was stored again and nothing was changed."
    report = FileReport(name=row.name, understood=[note], flagged=sessions.disagreements(db, ids, stated))
    return FileOutcome(name, row, [report], duplicate=True, session_ids=ids)


def _keep_and_decode(
    db: Session,
    participant: Participant,
    upload: Upload,
    stated: StatedSession,
    name: str,
    draft: Path,
    sha256: str,
    size: int,
    options: DecodeOptions,
) -> FileOutcome:
    kind, stored, removed, problem = _keep(db, draft, name, options)
    row = UploadFile(
        upload_id=upload.id,
        participant_id=participant.id,
        name=_harmless_name(name, kind),
        kind=kind,
        size=size,
        original_sha256=sha256,
        stored_sha256=stored,
        redactor_version=REDACTOR_VERSION,
        report={},
    )
    db.add(row)
    db.commit()  # the bytes are safe from here on, whatever the decoder does with them
    if problem is None:
        try:
            # made anew after the lock: somebody may have sent the same bytes while these were being redacted
            repository.lock_participant(db, participant.id)
            if known := _known(db, participant, stated, name, sha256):
                db.delete(row)
                db.commit()
                return known
            decoded = formats.decode(files.path_of(stored), kind, options, name=row.name)
            ids, duplicate, notes = sessions.store_recordings(db, participant, row, decoded.recordings, stated)
        except UndecodableFile as error:
            db.rollback()
            db.refresh(row)
            problem = error
        else:
            reports = list(decoded.reports)
            reports[0].removed.extend(removed)
            reports[0].understood.extend(notes)
            row.status = "decoded"
            row.report = {"reports": [asdict(r) for r in reports]}
            db.commit()
            return FileOutcome(name, row, reports, duplicate=duplicate, session_ids=ids)
    report = FileReport(name=row.name, removed=removed, problem=Problem(problem.what, problem.where, problem.mend))
    row.status = "failed"
    row.report = {"reports": [asdict(report)]}
    db.commit()
    return FileOutcome(name, row, [report])


def _keep(db: Session, draft: Path, name: str, options: DecodeOptions) -> tuple[str, str, list[str], UndecodableFile | None]:
    """Store a file without identity, or encrypted when it cannot be parsed: kind, hash of what is stored, what was removed, the problem."""
    try:
        kind = formats.sniff(draft, name)
        redacted, removed = formats.redact(draft, kind, _pseudonym_key(), options)
    except UndecodableFile as error:
        stored = files.store(db, quarantine.encrypt(draft), "application/octet-stream")
        return "unreadable", stored.sha256, [], error
    return kind, files.store(db, redacted, "application/octet-stream").sha256, removed, None


def _pseudonym_key() -> bytes:
    return get_settings().secret("pseudonyms")


def _harmless_name(name: str, kind: str) -> str:
    """Names of files carry names of people; what stays is the kind and the ending."""
    suffix = Path(name).suffix.lower()
    return f"{kind}{suffix if len(suffix) <= 9 and suffix[1:].isalnum() else ''}"


def stored_reports(row: UploadFile) -> list[FileReport]:
    """The reports of a file as they were stored."""
    return [FileReport(**{**r, "problem": Problem(**r["problem"]) if r["problem"] else None}) for r in row.report.get("reports", [])]
