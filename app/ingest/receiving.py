"""One file of an upload on its way in: safe on disk, identity out, decoded, and known again by its bytes or its content."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, cast

import structlog
from sqlalchemy.orm import Session

from app.ingest import formats, quarantine, repository, sessions
from app.ingest.formats import FileKind
from app.ingest.formats.log import DecodedFile, FileReport, Problem, TraceSource, UndecodableFile
from app.ingest.formats.numbers import unit_name
from app.ingest.formats.options import DecodeOptions
from app.ingest.formats.redact import REDACTOR_VERSION, Redaction, redact_rcs_zip, redact_table
from app.ingest.models import Upload, UploadFile
from app.ingest.sessions import StatedSession
from app.platform import files
from app.platform.errors import TooLarge
from app.settings import get_settings
from app.study.models import Participant

log = structlog.get_logger()

TABLES = ("csv", "parquet")
_MEDIA_TYPE = "application/octet-stream"


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
    """What became of one file. `name` is what the sender called it; it and `told`, the problem in the file's own words, are told back to
    the sender and never stored."""

    name: str
    row: UploadFile
    reports: list[FileReport]
    duplicate: bool = False
    session_ids: list[int] = field(default_factory=list)
    told: Problem | None = None

    @property
    def reports_for_sender(self) -> list[FileReport]:
        """The reports, naming the file as the sender does, and quoting it where that shows what is wrong."""
        own = [replace(r, name=self.name) if r.name == self.row.name else r for r in self.reports]
        return [replace(r, problem=self.told) if r.problem is not None and self.told is not None else r for r in own]


@dataclass(frozen=True)
class _Kept:
    """A file as it was stored, and why it cannot be decoded, if so."""

    kind: str
    stored_sha256: str
    quarantine_sha256: str | None
    redaction: Redaction
    problem: UndecodableFile | None


@dataclass(frozen=True)
class Receiver:
    """Takes the files of one upload, one after the other; a file of no use harms none of the others.

    Commits twice per file: when its bytes are safe, and when it is decoded, so that a crash in between loses nothing.
    """

    db: Session
    participant: Participant
    upload: Upload
    stated: StatedSession
    options: DecodeOptions
    beta: BetaStated

    def receive(self, one: Incoming) -> FileOutcome:
        """Keep a file and decode it. Raises TooLarge."""
        name = Path(one.name.replace("\\", "/")).name[:255] or "file"
        limit_mb = get_settings().upload_limit_mb
        try:
            draft, sha256, size = files.receive(one.stream, limit_mb * 1024 * 1024)
        except OverflowError as error:
            raise TooLarge(f"'{name}' is larger than {limit_mb} MiB.", "Split it, or have BETALOOP_UPLOAD_LIMIT_MB raised.") from error
        try:
            if known := self._known(name, sha256):
                return known
            kept = self._keep(draft)
        finally:
            draft.unlink(missing_ok=True)
        row = UploadFile(
            upload_id=self.upload.id,
            participant_id=self.participant.id,
            name=_harmless_name(name, kept.kind),
            kind=kept.kind,
            size=size,
            original_sha256=sha256,
            stored_sha256=kept.stored_sha256,
            quarantine_sha256=kept.quarantine_sha256,
            redactor_version=REDACTOR_VERSION,
            report={},
        )
        self.db.add(row)
        self.db.commit()  # the bytes are safe from here on, whatever the decoder does with them
        return self._decode(name, row, kept)

    def _known(self, name: str, sha256: str) -> FileOutcome | None:
        """The outcome for bytes that were decoded before: the same sessions, and nothing changed."""
        row = repository.decoded_file(self.db, self.participant.id, sha256)
        if row is None:
            return None
        ids = list(repository.session_ids_of_file(self.db, row.id))
        note = f"The same bytes came before, as '{row.name}' in upload {row.upload_id}; nothing was stored again and nothing was changed."
        report = FileReport(name=row.name, understood=[note], flagged=sessions.disagreements(self.db, ids, self.stated))
        return FileOutcome(name, row, [report], duplicate=True, session_ids=ids)

    def _keep(self, draft: Path) -> _Kept:
        """Store a file without identity; what could not be parsed, and so not be cleaned, is kept encrypted.

        A table is cleaned by reading it with the participant's options: one that cannot be decoded is kept encrypted too.
        """
        redaction, clean, quarantined = Redaction(), draft, None
        try:
            kind = formats.sniff(draft)
            if kind == "rcs":
                clean = files.draft_path()
                redaction = redact_rcs_zip(draft, clean, get_settings().secret("pseudonyms"), self.options.archive)
            else:
                clean = files.draft_path()
                redaction = redact_table(draft, clean, kind, self.options)
        except UndecodableFile as error:
            sealed = self._seal(draft)
            return _Kept("unreadable", sealed, sealed, Redaction(), error)
        if redaction.unreadable:
            quarantined = self._seal(draft)
        return _Kept(kind, files.store(self.db, clean, _MEDIA_TYPE).sha256, quarantined, redaction, None)

    def _seal(self, draft: Path) -> str:
        return files.store(self.db, quarantine.encrypt(draft), _MEDIA_TYPE).sha256

    def _decode(self, name: str, row: UploadFile, kept: _Kept) -> FileOutcome:
        if kept.problem is not None:
            return self._failed(name, row, kept, kept.problem)
        try:
            repository.lock_participant(self.db, self.participant.id)
            # asked again under the lock: somebody may have sent the same bytes meanwhile
            if known := self._known(name, row.original_sha256):
                self.db.delete(row)
                self.db.commit()
                return known
            decoded = formats.decode(files.path_of(kept.stored_sha256), cast(FileKind, kept.kind), self.options, name=row.name)
            if kept.kind in TABLES:
                decoded = self._name_beta(decoded)
            stored = sessions.store_recordings(self.db, self.participant, row, decoded.recordings, self.stated)
        except UndecodableFile as error:
            self.db.rollback()
            return self._failed(name, row, kept, error)
        except Exception as fault:
            # a fault of ours must not take the other files of the upload with it; the bytes are safe for a better decoder
            self.db.rollback()
            log.exception("decoder failed", upload_file=row.id, kind=kept.kind, fault=repr(fault))
            ours = UndecodableFile("the decoder failed on this file", "file", f"Tell your administrator: upload file {row.id}.")
            return self._failed(name, row, kept, ours)
        reports = list(decoded.reports)
        _tell(reports[0], kept.redaction, stored.notes)
        reports[0].flagged.extend(stored.flagged)
        self._finish(row, "decoded", reports)
        return FileOutcome(name, row, reports, duplicate=stored.known, session_ids=stored.session_ids)

    def _failed(self, name: str, row: UploadFile, kept: _Kept, problem: UndecodableFile) -> FileOutcome:
        report = FileReport(name=row.name, removed=kept.redaction.removed, problem=problem.stored)
        self._finish(row, "failed", [report])
        return FileOutcome(name, row, [report], told=problem.told)

    def _finish(self, row: UploadFile, status: str, reports: Sequence[FileReport]) -> None:
        row.status = status
        row.report = {"reports": [asdict(r) for r in reports]}
        self.db.commit()

    def _name_beta(self, decoded: DecodedFile) -> DecodedFile:
        """A table's beta under its source, with a sentence that says who stated unit and source."""
        settings = self.participant.current_settings
        source = cast(TraceSource, self.beta.source or settings.beta_source or "table")
        recordings = tuple(
            replace(r, traces=tuple(replace(t, source=source) if t.stream == "beta" else t for t in r.traces)) for r in decoded.recordings
        )
        report = decoded.reports[0]
        source_from = _whence(self.beta.source, settings.beta_source)
        for trace in (t for r in recordings for t in r.traces if t.stream == "beta"):
            in_header = trace.details["unit_from"] == "header"
            unit_from = "as the file's header says" if in_header else _whence(self.beta.unit, settings.beta_unit)
            report.understood.append(f"beta: unit '{trace.unit}' {unit_from}, source '{source}' {source_from}")
            if in_header and self.beta.unit and unit_name(self.beta.unit) != trace.unit:
                stated = unit_name(self.beta.unit)
                report.flagged.append(f"the file's header gives beta in '{trace.unit}', the upload says '{stated}': the header was taken")
        return replace(decoded, recordings=recordings)


def _whence(by_upload: str | None, by_settings: str | None) -> str:
    """Who stated a unit or a source."""
    if by_upload:
        return "as stated with the upload"
    return "as the participant's settings say" if by_settings else "because nobody stated one"


def _tell(report: FileReport, redaction: Redaction, notes: Sequence[str]) -> None:
    """Add to the first report what cleaning the file found, and which session came out."""
    report.removed.extend(redaction.removed)
    report.repaired.extend(redaction.repaired)
    report.ignored.extend(redaction.ignored)
    report.flagged.extend(f"kept encrypted, because it could not be read: {u}" for u in redaction.unreadable)
    report.understood.extend(notes)


def _harmless_name(name: str, kind: str) -> str:
    """Names of files carry names of people; what stays is the kind and the ending."""
    suffix = Path(name).suffix.lower()
    return f"{kind}{suffix if len(suffix) <= 9 and suffix[1:].isalnum() else ''}"
