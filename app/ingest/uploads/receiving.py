"""One file of an upload on its way in: safe on disk, identity out, decoded, and known again by its bytes or its content.

Which sessions come out is decided when all files of the upload are in; see `app.ingest.uploads.service`.
"""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import cast

import structlog
from sqlalchemy.orm import Session

from app.ingest import encryption, repository
from app.ingest.models import Upload, UploadFile
from app.ingest.uploads import outcomes as outcomes_intake
from app.ingest.uploads import recordings
from app.ingest.uploads.incoming import Incoming
from app.platform import files
from app.platform.errors import TooLarge
from app.settings import get_settings
from app.study.models import Participant, Recording, SettingsVersion
from ml import formats
from ml.formats import FileKind
from ml.formats.archive import ZipFiles
from ml.formats.options import ArchiveLimits, DecodeOptions
from ml.formats.rcs.folder import find_sessions
from ml.formats.recording import DecodedFile, FileReport, GraspLog, Problem, TraceLog, TraceSource, UndecodableFile
from ml.formats.redaction import REDACTOR_VERSION, Redaction
from ml.formats.tables.numbers import unit_name

log = structlog.get_logger()

EMPTY = UndecodableFile("the file is empty", "0 bytes", "Send the file again from where it was recorded; an empty one is not kept.")
CUT_SHORT = UndecodableFile(
    "the service was stopped while it took this file", "file", "Read it again on the page of the quarantine, or send it again."
)
TAKEN_UP = "The service was stopped while it read this file and has read it from the kept bytes since; what was removed is not told again."
TABLES = ("csv", "parquet")
MEDIA_TYPE = "application/octet-stream"


@dataclass(frozen=True)
class BetaStated:
    """What the sender says of a table: unit and source (as in the settings) of its beta, and the unit of its LFP."""

    unit: str | None = None
    source: str | None = None
    lfp_unit: str | None = None


@dataclass
class FileOutcome:
    """What became of one file. `name` is what the sender called it; it and `told`, the problem in the file's own words, are told back to
    the sender and never stored.

    Attributes:
        duplicate: its bytes, or all of its recordings, had come before. same_bytes: its bytes had; `row` is the earlier file then.
        session_ids: sessions that it belongs to.
        recordings: what it holds, new and known.
        grasps: hand-grasp tests that wait for their session.
    """

    name: str
    row: UploadFile
    reports: list[FileReport]
    duplicate: bool = False
    same_bytes: bool = False
    session_ids: list[int] = field(default_factory=list)
    told: Problem | None = None
    recordings: list[Recording] = field(default_factory=list)
    grasps: Sequence[GraspLog] = ()

    @property
    def reports_for_sender(self) -> list[FileReport]:
        """The reports, naming the file as the sender does, and quoting it where that shows what is wrong."""
        own = [replace(r, name=self.name) if r.name == self.row.name else r for r in self.reports]
        return [replace(r, problem=self.told) if r.problem is not None and self.told is not None else r for r in own]


@dataclass(frozen=True)
class Kept:
    """A file as it was stored, and why it cannot be decoded, if so."""

    kind: str
    stored_sha256: str | None
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
            kept = self._keep(draft) if size else Kept("unreadable", None, None, Redaction(), EMPTY)
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
        return self.decode(name, row, kept)

    def _known(self, name: str, sha256: str) -> FileOutcome | None:
        """The outcome for bytes that were decoded before: the same recordings, and nothing stored again."""
        row = repository.decoded_file(self.db, self.participant.id, sha256)
        if row is None:
            return None
        note = f"The same bytes came before, as '{row.name}' in upload {row.upload_id}; nothing was stored again."
        report = FileReport(name=row.name, understood=[note])
        return FileOutcome(name, row, [report], duplicate=True, same_bytes=True, recordings=self._recordings(row))

    def _recordings(self, row: UploadFile) -> list[Recording]:
        return [*repository.recordings_of_file(self.db, row.id), *repository.recordings_by_id(self.db, known_recordings(row))]

    def take_up(self, row: UploadFile) -> FileOutcome:
        """Go on with a file of an upload that was interrupted: decode it where that is still to do, else as it was left."""
        if row.status != "received":
            return FileOutcome(row.name, row, stored_reports(row), recordings=self._recordings(row))
        sealed = row.stored_sha256 is None or row.stored_sha256 == row.quarantine_sha256
        outcome = self.decode(
            row.name, row, Kept(row.kind, row.stored_sha256, row.quarantine_sha256, Redaction(), CUT_SHORT if sealed else None)
        )
        if not outcome.same_bytes:
            outcome.reports[0].understood.append(TAKEN_UP)
            store_reports(row, outcome.reports, known_recordings(row))
        return outcome

    def _keep(self, draft: Path) -> Kept:
        """Store a file without identity; what could not be parsed, and so not be cleaned, is kept encrypted.

        A table is cleaned by reading it with the participant's options: one that cannot be decoded is kept encrypted too.
        """
        clean = files.draft_path()
        try:
            kind = formats.sniff(draft)
            redaction = formats.redact(draft, clean, kind, get_settings().secret("pseudonyms"), self.options)
        except UndecodableFile as error:
            return self._quarantined(draft, clean, error)
        except Exception as fault:
            # a fault of ours must not take the other files of the upload with it, and what it left behind may still name a person
            log.exception("file could not be cleaned", upload=self.upload.id, fault=repr(fault))
            mend = f"It is kept encrypted; tell your administrator: upload {self.upload.id}."
            return self._quarantined(
                draft, clean, UndecodableFile("the service failed while it took identity out of this file", "file", mend)
            )
        sealed = self._seal(draft) if redaction.unreadable else None
        return Kept(kind, files.store(self.db, clean, MEDIA_TYPE).sha256, sealed, redaction, None)

    def _quarantined(self, draft: Path, clean: Path, problem: UndecodableFile) -> Kept:
        clean.unlink(missing_ok=True)
        left_out = _left_out(draft, self.options.archive)
        sealed = self._seal(draft)
        return Kept("unreadable", sealed, sealed, Redaction(ignored=left_out), problem)

    def _seal(self, draft: Path) -> str:
        return files.store(self.db, encryption.encrypt(draft), MEDIA_TYPE).sha256

    def decode(self, name: str, row: UploadFile, kept: Kept) -> FileOutcome:
        """Decode a stored file; whatever is wrong with it becomes its report."""
        if kept.problem is not None or kept.stored_sha256 is None:
            return self._failed(name, row, kept, kept.problem or CUT_SHORT)
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
            stored = recordings.store(self.db, self.participant, row, decoded.recordings)
            tremor = outcomes_intake.take_tremor(self.db, row, decoded.tremor)
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
        _tell(reports[0], kept.redaction, tremor)
        row.status = "decoded"
        store_reports(row, reports, [r.id for r in stored.known])
        self.db.commit()
        all_known = bool(stored.known) and not stored.fresh
        return FileOutcome(name, row, reports, all_known, recordings=[*stored.known, *stored.fresh], grasps=decoded.grasps)

    def _failed(self, name: str, row: UploadFile, kept: Kept, problem: UndecodableFile) -> FileOutcome:
        report = FileReport(name=row.name, problem=problem.stored)
        _tell(report, kept.redaction, ())
        before = repository.failed_file(self.db, self.participant.id, row) if row.decided_at is None else None
        if before is not None:
            return self._failed_before(name, row, before, report, problem)
        row.status = "failed"
        store_reports(row, [report])
        self.db.commit()
        return FileOutcome(name, row, [report], told=problem.told)

    def _failed_before(self, name: str, row: UploadFile, before: UploadFile, report: FileReport, problem: UndecodableFile) -> FileOutcome:
        """The same bytes were of no use before, and still are: they are kept once."""
        report.understood.append(f"The same bytes came before, as file {before.id} in upload {before.upload_id}; they are kept once.")
        sealed = row.quarantine_sha256
        self.db.delete(row)
        self.db.flush()
        if sealed is not None:
            # encrypted anew each time, so that no other row has these bytes
            self.db.delete(self.db.get_one(files.StoredFile, sealed))
        store_reports(before, [report])
        self.db.commit()
        if sealed is not None:
            files.path_of(sealed).unlink(missing_ok=True)
        return FileOutcome(name, before, [report], duplicate=True, same_bytes=True, told=problem.told)

    def _name_beta(self, decoded: DecodedFile) -> DecodedFile:
        """A table's beta under its source, with a sentence that says who stated unit and source."""
        return name_beta(decoded, self.beta, self.participant.current_settings)


def name_beta(decoded: DecodedFile, beta: BetaStated, settings: SettingsVersion) -> DecodedFile:
    """A table's own beta under its source; the report gets a sentence that says who stated unit and source.

    Beta that was computed here, from a table of raw LFP, keeps the source `time_domain` and the unit it was computed in.
    """
    source = cast(TraceSource, beta.source or settings.beta_source or "table")
    named = tuple(
        replace(r, traces=tuple(replace(t, source=source) if _stated_by_a_person(t) else t for t in r.traces)) for r in decoded.recordings
    )
    report = decoded.reports[0]
    source_from = _whence(beta.source, settings.beta_source)
    for trace in (t for r in decoded.recordings for t in r.traces if _stated_by_a_person(t)):
        in_header = trace.details["unit_from"] == "header"
        unit_from = "as the file's header says" if in_header else _whence(beta.unit, settings.beta_unit)
        report.understood.append(f"beta: unit '{trace.unit}' {unit_from}, source '{source}' {source_from}")
        if in_header and beta.unit and unit_name(beta.unit) != trace.unit:
            stated = unit_name(beta.unit)
            report.flagged.append(f"the file's header gives beta in '{trace.unit}', the upload says '{stated}': the header was taken")
    return replace(decoded, recordings=named)


def _stated_by_a_person(trace: TraceLog) -> bool:
    """Whether a trace is the beta column of a table, whose source nobody but a person can tell."""
    return trace.stream == "beta" and trace.source == "table"


def store_reports(row: UploadFile, reports: Sequence[FileReport], known: Sequence[int] = ()) -> None:
    """Keep a file's reports, and which of its recordings had come before in other files."""
    row.report = {"reports": [asdict(r) for r in reports], "known_recordings": list(known)}


def stored_reports(row: UploadFile) -> list[FileReport]:
    """The reports of a file as they were stored."""
    return [FileReport(**{**r, "problem": Problem(**r["problem"]) if r["problem"] else None}) for r in row.report.get("reports", [])]


def known_recordings(row: UploadFile) -> list[int]:
    """Recordings of a file that another file had brought before."""
    found: list[int] = row.report.get("known_recordings", [])
    return found


def _whence(by_upload: str | None, by_settings: str | None) -> str:
    """Who stated a unit or a source."""
    if by_upload:
        return "as stated with the upload"
    return "as the participant's settings say" if by_settings else "because nobody stated one"


def _tell(report: FileReport, redaction: Redaction, notes: Sequence[str]) -> None:
    """Add to a report what cleaning the file found, and what was made of it."""
    for ours, found in ((report.removed, redaction.removed), (report.repaired, redaction.repaired), (report.ignored, redaction.ignored)):
        ours.extend(sentence for sentence in found if sentence not in ours)
    report.flagged.extend(f"kept encrypted, because it could not be read: {u}" for u in redaction.unreadable)
    report.understood.extend(notes)


def _left_out(path: Path, limits: ArchiveLimits) -> list[str]:
    """Why members of an archive of no use were left out, counted, without their names, which may identify a person."""
    if not zipfile.is_zipfile(path):
        return []
    listing = FileReport("archive")
    try:
        with ZipFiles(path, limits) as members:
            find_sessions(members, listing)
            reasons = Counter(sentence.rsplit(": ", 1)[-1] for sentence in members.ignored)
    except UndecodableFile:
        return []  # the problem itself says what is wrong with the archive
    return [*listing.ignored, *(f"{n} file{'s' if n > 1 else ''}: {reason}" for reason, n in sorted(reasons.items()))]


def _harmless_name(name: str, kind: str) -> str:
    """Names of files carry names of people; what stays is the kind and the ending."""
    suffix = Path(name).suffix.lower()
    return f"{kind}{suffix if len(suffix) <= 9 and suffix[1:].isalnum() else ''}"
