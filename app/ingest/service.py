"""Rules of uploads: bytes first, then identity out, then recordings and sessions; the same bytes twice are one recording.

The caller commits nothing: an upload has two commits of its own, one when the bytes are safe and one when they are decoded, so that a
crash between them loses nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, cast

from sqlalchemy.orm import Session

from app.accounts import policy as can
from app.accounts.policy import Caller
from app.ingest import formats, quarantine, repository, sessions
from app.ingest.formats import FileKind
from app.ingest.formats.log import DecodedFile, FileReport, Problem, TraceSource, UndecodableFile
from app.ingest.formats.options import ArchiveLimits, DecodeOptions
from app.ingest.formats.redact import REDACTOR_VERSION, Redaction, redact_rcs_zip
from app.ingest.models import Upload, UploadFile
from app.ingest.sessions import StatedSession
from app.platform import files
from app.platform.errors import Invalid, TooLarge
from app.settings import get_settings
from app.study import repository as study
from app.study import service as study_service
from app.study.models import Controller, Participant

TABLES = ("csv", "parquet")


@dataclass(frozen=True)
class Incoming:
    """One file as it arrives."""

    name: str
    stream: BinaryIO


@dataclass(frozen=True)
class BetaStated:
    """What the sender says of a table's beta column: unit and source (`time_domain`, `device_power`, `percept_lfp`, `table`)."""

    unit: str | None = None
    source: str | None = None


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


@dataclass(frozen=True)
class Kept:
    """A file as it was stored: what it is, the hash of the stored bytes, what was taken out, and why it cannot be decoded, if so."""

    kind: str
    stored_sha256: str
    redaction: Redaction
    problem: UndecodableFile | None


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
    beta: BetaStated | None = None,
) -> UploadOutcome:
    """Take an upload: keep every file, decode what can be decoded, make sessions.

    `beta` says what the beta column of a table is; the participant's unit and source are taken, and said, where it is silent.

    Raises:
        TooLarge: a file exceeds the installation's limit; files before it are kept.
    """
    study_service.require(caller, can.UPLOAD, participant)
    if not incoming:
        raise Invalid("The upload holds no file.", "Choose at least one file.")
    beta = beta or BetaStated()
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
            "beta_unit": beta.unit,
            "beta_source": beta.source,
        },
    )
    db.add(upload)
    db.flush()
    options = decode_options(participant, beta)
    outcomes = [_receive_file(db, participant, upload, stated, one, options, beta) for one in incoming]
    upload.report = [asdict(r) for o in outcomes for r in o.reports]
    upload.status = "decoded" if any(o.row.status == "decoded" for o in outcomes) else "failed"
    db.commit()
    return UploadOutcome(upload, participant, outcomes)


def decode_options(participant: Participant, beta: BetaStated) -> DecodeOptions:
    """The participant's choices for decoders."""
    settings = participant.current_settings
    return DecodeOptions(
        period_s=settings.period_s,
        beta_low_hz=settings.beta_low_hz,
        beta_high_hz=settings.beta_high_hz,
        min_valid_fraction=settings.min_valid_fraction,
        table_beta_unit=beta.unit or settings.beta_unit or "unstated",
        archive=ArchiveLimits(),
    )


def _receive_file(
    db: Session,
    participant: Participant,
    upload: Upload,
    stated: StatedSession,
    one: Incoming,
    options: DecodeOptions,
    beta: BetaStated,
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
        return known or _keep_and_decode(db, participant, upload, stated, name, draft, sha256, size, options, beta)
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
    beta: BetaStated,
) -> FileOutcome:
    kept = _keep(db, draft, options)
    problem = kept.problem
    row = UploadFile(
        upload_id=upload.id,
        participant_id=participant.id,
        name=_harmless_name(name, kept.kind),
        kind=kept.kind,
        size=size,
        original_sha256=sha256,
        stored_sha256=kept.stored_sha256,
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
            decoded = formats.decode(files.path_of(kept.stored_sha256), cast(FileKind, kept.kind), options, name=row.name)
            if kept.kind in TABLES:
                decoded = _name_beta(decoded, participant, beta)
            ids, duplicate, notes = sessions.store_recordings(db, participant, row, decoded.recordings, stated)
        except UndecodableFile as error:
            db.rollback()
            db.refresh(row)
            problem = error
        else:
            reports = list(decoded.reports)
            reports[0].removed.extend(kept.redaction.removed)
            reports[0].repaired.extend(kept.redaction.repaired)
            reports[0].ignored.extend(kept.redaction.ignored)
            reports[0].flagged.extend(f"not kept, because it could not be read: {u}" for u in kept.redaction.unreadable)
            reports[0].understood.extend(notes)
            row.status = "decoded"
            row.report = {"reports": [asdict(r) for r in reports]}
            db.commit()
            return FileOutcome(name, row, reports, duplicate=duplicate, session_ids=ids)
    report = FileReport(name=row.name, removed=kept.redaction.removed, problem=Problem(problem.what, problem.where, problem.mend))
    row.status = "failed"
    row.report = {"reports": [asdict(report)]}
    db.commit()
    return FileOutcome(name, row, [report])


def _keep(db: Session, draft: Path, options: DecodeOptions) -> Kept:
    """Store a file without identity, or encrypted when it cannot be parsed."""
    try:
        kind = formats.sniff(draft)
        redaction = Redaction()
        clean = draft
        if kind == "rcs":
            clean = files.draft_path()
            redaction = redact_rcs_zip(draft, clean, get_settings().secret("pseudonyms"), options.archive)
    except UndecodableFile as error:
        sealed = files.store(db, quarantine.encrypt(draft), "application/octet-stream")
        return Kept("unreadable", sealed.sha256, Redaction(), error)
    return Kept(kind, files.store(db, clean, "application/octet-stream").sha256, redaction, None)


def _name_beta(decoded: DecodedFile, participant: Participant, beta: BetaStated) -> DecodedFile:
    """A table's beta under its source, with a sentence where the participant's unit and source were taken."""
    settings = participant.current_settings
    source = cast(TraceSource, beta.source or settings.beta_source or "table")
    recordings = tuple(
        replace(r, traces=tuple(replace(t, source=source) if t.stream == "beta" else t for t in r.traces)) for r in decoded.recordings
    )
    for trace in (t for r in recordings for t in r.traces if t.stream == "beta"):
        whose = "as stated" if beta.unit and beta.source else "as the participant's settings say, where the upload does not"
        decoded.reports[0].understood.append(f"beta is in '{trace.unit}' from '{source}', {whose}")
    return replace(decoded, recordings=recordings)


def _harmless_name(name: str, kind: str) -> str:
    """Names of files carry names of people; what stays is the kind and the ending."""
    suffix = Path(name).suffix.lower()
    return f"{kind}{suffix if len(suffix) <= 9 and suffix[1:].isalnum() else ''}"


def stored_reports(row: UploadFile) -> list[FileReport]:
    """The reports of a file as they were stored."""
    return [FileReport(**{**r, "problem": Problem(**r["problem"]) if r["problem"] else None}) for r in row.report.get("reports", [])]
