"""One file of an upload on its way in: safe on disk, identity out, decoded, and known again by its bytes or its content.

Which sessions come out is decided when all files of the upload are in; see `app.ingest.uploads.service`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import structlog
from sqlalchemy.orm import Session

from app.ingest import encryption, repository, wording
from app.ingest.mappings import repository as mappings
from app.ingest.stated_beta import BetaStated, name_beta
from app.ingest.uploads import outcomes as outcomes_intake
from app.ingest.uploads import reading, recordings
from app.ingest.uploads.in_progress import not_counted, tell
from app.ingest.uploads.incoming import Incoming
from app.ingest.uploads.reading import FileParts, ReaderEnded, ReaderFault, twice
from app.ingest.uploads.reports import ASIDE, BEGUN, add_redaction, known_recordings, lasting, store_reports, stored_reports
from app.platform import files, raw_bytes
from app.platform.database import end_reading
from app.platform.errors import TooLarge, passing
from app.platform.jobs.children import child
from app.platform.raw_bytes import RawFile
from app.settings import get_settings
from app.tables.participants import Participant
from app.tables.recordings import Recording
from app.tables.uploads import PREVIEW, StoredFile, Upload, UploadFile
from ml.formats import REDACTOR_VERSION, DecodedFile, DecodeOptions, FileReport, OutcomeLog, Problem, Redaction, Source, UndecodableFile
from ml.formats.archive import cleaned_suffix

log = structlog.get_logger()

EMPTY = UndecodableFile("the file is empty", "0 bytes", "Send the file again from where it was recorded; an empty one is not content.")
CUT_SHORT = UndecodableFile(
    "the service was stopped while it took this file", "file", "Read it again on the page of the quarantine, or send it again."
)
LETHAL = 2
"""Number of times a process may end while it reads a file, or makes sessions of an upload. After that it is not retried automatically."""
ENDED_THE_SERVICE = UndecodableFile(
    f"reading this file was cut short {LETHAL} times: the service, or what it rests on, stopped while it was read",
    "file",
    "Look at it on the page of the quarantine. Send it again with what is wrong mended, or read it again when the service was mended.",
)
RESUMED = "Reading this file was cut short; it was read from the kept bytes since, and what was removed from it is not listed again."
TABLES = ("csv", "parquet", "control_log", "mapped")


@dataclass
class FileOutcome:
    """Result of one file. `name` is what the sender called it, `for_sender` the problem in the file's own words. Both go back to the sender
    and are never stored.

    Attributes:
        duplicate: its bytes, or all of its recordings, had come before. same_bytes: its bytes had; `row` is the earlier file then.
        session_ids: sessions that it belongs to.
        recordings: what it holds, new and known.
        outcomes: measurements, of which some wait for their session.
    """

    name: str
    row: UploadFile
    reports: list[FileReport]
    duplicate: bool = False
    same_bytes: bool = False
    session_ids: list[int] = field(default_factory=list)
    for_sender: Problem | None = None
    recordings: list[Recording] = field(default_factory=list)
    outcomes: Sequence[OutcomeLog] = ()

    @property
    def reports_for_sender(self) -> list[FileReport]:
        """The reports, naming the file as the sender does, and quoting it where that shows what is wrong."""
        own = [replace(r, name=self.name) if r.name == self.row.name else r for r in self.reports]
        return [replace(r, problem=self.for_sender) if r.problem is not None and self.for_sender is not None else r for r in own]


@dataclass(frozen=True)
class StoredContent:
    """A file as it was stored, and why it cannot be decoded, if so. It also names the column mapping that read it, or has what a mapping
    may be made from."""

    kind: str
    stored_sha256: str | None
    quarantine_sha256: str | None
    redaction: Redaction
    problem: UndecodableFile | None
    column_mapping_id: int | None = None
    preview: dict[str, Any] | None = None


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
    kept: list[int] = field(default_factory=list)
    """Files of which the bytes are safe."""

    def receive(self, one: Incoming) -> FileOutcome | FileParts:
        """Keep a file and decode it; return the parts of one that holds several, of which nothing was kept. Raises TooLarge."""
        name = Path(one.name.replace("\\", "/")).name[:255] or "file"
        limit_mb = get_settings().upload_limit_mb
        try:
            with raw_bytes.received(one.stream, limit_mb * 1024 * 1024) as (raw, sha256, size):
                if known := self._known(name, sha256):
                    mended = self._mended(raw, known)
                    self.db.add(self.upload)
                    return self._keep_outcome(mended)
                try:
                    if (several := reading.parts(raw, self.options, str(self.upload.id), self._told)) is not None:
                        return several
                    content = self._store(raw) if size else StoredContent("unreadable", None, None, Redaction(), EMPTY)
                except UndecodableFile as mixed:
                    content = self._quarantined(raw, files.draft_path(), mixed)
        except OverflowError as error:
            raise TooLarge(f"'{name}' is larger than {limit_mb} MiB.", "Split it, or have BETALOOP_UPLOAD_LIMIT_MB raised.") from error
        row = UploadFile(
            upload_id=self.upload.id,
            participant_id=self.participant.id,
            name=_harmless_name(name, content.kind),
            kind=content.kind,
            size=size,
            original_sha256=sha256,
            stored_sha256=content.stored_sha256,
            quarantine_sha256=content.quarantine_sha256,
            redactor_version=REDACTOR_VERSION,
            column_mapping_id=content.column_mapping_id,
            report={BEGUN: 1} | ({PREVIEW: content.preview} if content.preview else {}),
        )
        self.db.add_all((self.upload, row))
        self.db.commit()  # the bytes are safe from here on, whatever the decoder does with them
        self.kept.append(row.id)
        return self.decode(name, row, content)

    def _known(self, name: str, sha256: str) -> FileOutcome | None:
        """Build the outcome for bytes that were decoded before: the same recordings, and nothing stored again."""
        row = repository.decoded_file(self.db, self.participant.id, sha256)
        if row is None:
            return None
        note = f"The same bytes came before, as '{row.name}' in upload {row.upload_id}; nothing was stored again."
        report = FileReport(name=row.name, understood=[note])
        return FileOutcome(name, row, [report], duplicate=True, same_bytes=True, recordings=self._recordings(row))

    def _mended(self, raw: RawFile, known: FileOutcome) -> FileOutcome:
        """Build the outcome for bytes that came before; where their stored form is missing or damaged, they replace it."""
        row = known.row
        end_reading(self.db)  # the bucket may take its time
        if row.stored_sha256 is None or files.is_whole(row.stored_sha256):
            return known
        content = self._store(raw)
        if content.problem is not None or content.stored_sha256 is None:
            self._forget(content.quarantine_sha256)
            return known
        log.warning("a stored file was damaged and is made anew", upload_file=row.id, sha256=row.stored_sha256)
        damaged, spare = row.stored_sha256, content.quarantine_sha256
        # a newer betaloop, or another column mapping, may make other bytes of it
        row.kind, row.stored_sha256, row.column_mapping_id = content.kind, content.stored_sha256, content.column_mapping_id
        row.redactor_version = REDACTOR_VERSION
        if row.quarantine_sha256 is not None and spare is not None and row.decided_at is None:
            row.quarantine_sha256, spare = spare, row.quarantine_sha256
        self._forget(spare)
        self._forget(damaged)
        known.reports[0].understood.append(wording.MADE_ANEW)
        return known

    def _forget(self, sha256: str | None) -> None:
        """Remove bytes that no file names any more in this transaction. The caller commits.

        They go before that: where the service is stopped in between, the file still names them, and the same is done again. The other
        way round, bytes that nothing names would stay for ever.
        """
        self.db.flush()
        if sha256 is not None and not repository.names_stored(self.db, sha256):
            self.db.delete(self.db.get_one(StoredFile, sha256))
            self.db.flush()
            files.remove(sha256)

    def _recordings(self, row: UploadFile) -> list[Recording]:
        mine = [*repository.recordings_of_file(self.db, row.id), *repository.recordings_by_id(self.db, known_recordings(row))]
        return repository.fullest(self.db, mine)

    def resume(self, row: UploadFile) -> FileOutcome:
        """Resume a file of an upload that was interrupted: decode it where that is still to do, else leave it."""
        if row.status != "received":
            return FileOutcome(row.name, row, stored_reports(row), recordings=self._recordings(row))
        sealed = row.stored_sha256 is None or row.stored_sha256 == row.quarantine_sha256
        if not sealed and row.report.get(BEGUN, 0) >= LETHAL:
            return self._keep_outcome(self._put_aside(row, self._content(row), ENDED_THE_SERVICE))
        # committed before the file is read, so that it is known whom to blame when that ends the process
        self._count_begin(row, row.report.get(BEGUN, 0))
        with not_counted(self.db, lambda: _forget_begin(row)):
            outcome = self.decode(row.name, row, replace(self._content(row), problem=CUT_SHORT if sealed else None))
        if not outcome.same_bytes:
            outcome.reports[0].understood.append(RESUMED)
            store_reports(row, outcome.reports, known_recordings(row))
        return outcome

    def _count_begin(self, row: UploadFile, times: int) -> None:
        """Record that a file is read once more than so often. Commits."""
        row.report = {**lasting(row), BEGUN: times + 1}
        self.db.commit()

    @staticmethod
    def _content(row: UploadFile) -> StoredContent:
        return StoredContent(row.kind, row.stored_sha256, row.quarantine_sha256, Redaction(), None)

    def _refuse_another_participants(self, decoded: DecodedFile) -> None:
        """Raise UndecodableFile for a controller's log that says it is of another participant: nothing of it may count here."""
        for recording in decoded.recordings:
            whose = (recording.settings.get("controller") or {}).get("participant")
            if whose and whose != self.participant.code:
                what = f"this log of a controller is of a session of participant {whose}, not of {self.participant.code}"
                raise UndecodableFile(what, "first line", f"Upload it for {whose}; if that is wrong, ask which tablet it came from.")

    def _put_aside(self, row: UploadFile, content: StoredContent, problem: UndecodableFile) -> FileOutcome:
        """Put a file into quarantine that ends the processes which read it; a person decides on it there."""
        assert content.stored_sha256 is not None
        log.error("file put aside: reading it ended the reader", upload_file=row.id, why=problem.stored_what)
        sealed = row.quarantine_sha256 is not None
        if not sealed:
            row.quarantine_sha256 = self._seal(files.path_of(content.stored_sha256))
        row.report = lasting(row) if sealed else {ASIDE: content.stored_sha256}
        return self._failed(row.name, row, replace(content, quarantine_sha256=row.quarantine_sha256), problem)

    def _told(self, share: float | None, doing: str | None) -> None:
        tell(self.upload.id, share, doing)

    def _store(self, raw: RawFile) -> StoredContent:
        """Store a file without identity; what could not be parsed, and so not be cleaned, is kept encrypted.

        A table is cleaned by reading it with the participant's options: one that cannot be decoded is kept encrypted too. Nothing is
        written before, and no connection is kept while the file is cleaned and travels.
        """
        clean = files.draft_path()
        known = mappings.present(self.db, self.participant.site.study_id)
        ways = [m.as_mapping for m in known]
        end_reading(self.db)
        try:
            found = twice(lambda: reading.clean(raw, clean, self.options, str(self.upload.id), self._told, ways))
        except ReaderEnded as ended:
            log.error("file put aside: cleaning it ended the reader", upload=self.upload.id, cause=ended.cause)
            return self._quarantined(raw, clean, ended)
        except ReaderFault as fault:
            # a fault of ours must not take the other files of the upload with it, and what it left behind may still name a person
            log.error("file could not be cleaned", upload=self.upload.id, places=fault.places)
            hint = f"It is kept encrypted; tell your administrator: upload {self.upload.id}."
            return self._quarantined(
                raw, clean, UndecodableFile("the service failed while it took identity out of this file", "file", hint)
            )
        except BaseException:
            clean.unlink(missing_ok=True)
            raise
        if found.problem is not None:
            return self._quarantined(raw, clean, found.problem, found.redaction, found.preview)
        sealed = files.keep_bytes(encryption.encrypt(raw), copy=False) if found.redaction.unreadable else None
        stored = files.record(self.db, files.keep_bytes(clean)).sha256
        by = known[found.mapping].id if found.mapping is not None else None
        original = files.record(self.db, sealed).sha256 if sealed else None
        return StoredContent(found.kind, stored, original, found.redaction, None, by)

    def _quarantined(
        self,
        raw: RawFile,
        clean: Path,
        problem: UndecodableFile,
        redaction: Redaction | None = None,
        preview: dict[str, Any] | None = None,
    ) -> StoredContent:
        clean.unlink(missing_ok=True)
        sealed = self._seal(raw)
        return StoredContent("unreadable", sealed, sealed, redaction or Redaction(), problem, preview=preview)

    def _seal(self, raw: Source) -> str:
        return files.store(self.db, encryption.encrypt(raw), copy=False).sha256

    def decode(self, name: str, row: UploadFile, content: StoredContent) -> FileOutcome:
        """Decode a stored file; whatever is wrong with it becomes its report. Commits."""
        return self._keep_outcome(self._outcome(name, row, content))

    def _keep_outcome(self, outcome: FileOutcome) -> FileOutcome:
        """Commit what became of a file: no file that follows it can take that back."""
        self.db.commit()
        return outcome

    def _outcome(self, name: str, row: UploadFile, content: StoredContent) -> FileOutcome:
        if content.problem is not None or content.stored_sha256 is None:
            return self._failed(name, row, content, content.problem or CUT_SHORT)
        try:
            if (known := self._known_meanwhile(name, row)) is not None:
                return known
            decoded = self._decoded(row, content)
            self._refuse_another_participants(decoded)
            repository.lock_participant(self.db, self.participant.id)
            # asked again under the lock: another upload may have brought the same bytes in between
            if (known := self._known_meanwhile(name, row)) is not None:
                return known
            if content.kind in TABLES:
                decoded = name_beta(decoded, self.beta, self.participant.current_settings)
            stored = recordings.store(self.db, self.participant, row, decoded.recordings)
            derived = outcomes_intake.take_clocked(self.db, row, decoded.outcomes)
        except ReaderEnded as ended:
            return self._put_aside(row, content, ended)
        except UndecodableFile as error:
            self.db.rollback()
            return self._failed(name, row, content, error)
        except Exception as fault:
            if passing(fault) is not None:
                raise  # nothing is wrong with the file: it is read when the fault is over
            # a fault of ours must not take the other files of the upload with it; the bytes are safe for a better decoder
            self.db.rollback()
            places = fault.places if isinstance(fault, ReaderFault) else child.places(fault)
            log.error("decoder failed", upload_file=row.id, kind=content.kind, places=places)
            ours = UndecodableFile("the decoder failed on this file", "file", f"Tell your administrator: upload file {row.id}.")
            return self._failed(name, row, content, ours)
        reports = list(decoded.reports)
        add_redaction(reports[0], content.redaction, derived)
        if row.column_mapping is not None:
            reports[0].understood.insert(0, wording.read_by_mapping(row.column_mapping))
        reports[0].understood.extend(stored.understood)
        reports[0].flagged.extend(stored.flagged)
        row.status = "decoded"
        store_reports(row, reports, [r.id for r in stored.known], content.redaction.unreadable)
        all_known = bool(stored.known) and not stored.fresh
        return FileOutcome(name, row, reports, all_known, recordings=[*stored.known, *stored.fresh], outcomes=decoded.outcomes)

    def _known_meanwhile(self, name: str, row: UploadFile) -> FileOutcome | None:
        """Build the outcome for a file whose bytes another upload has brought since; the row goes then."""
        known = self._known(name, row.original_sha256)
        if known is None or known.row.id == row.id:
            return None
        self.db.delete(row)
        self._forget(row.quarantine_sha256)
        return known

    def _decoded(self, row: UploadFile, content: StoredContent) -> DecodedFile:
        """Decode a stored file in a child. One that ends it is read once more, which is recorded before, should that end us too.

        Raises:
            ReaderEnded: at the second time.
        """
        assert content.stored_sha256 is not None
        path = files.path_of(content.stored_sha256)

        def read() -> DecodedFile:
            return reading.decode(path, content.kind, self.options, row.name, str(self.upload.id), self._told)

        def again() -> bool:
            begun = row.report.get(BEGUN, 1)
            if begun < LETHAL:
                self._count_begin(row, begun)
            return bool(begun < LETHAL)

        return twice(read, again)

    def _failed(self, name: str, row: UploadFile, content: StoredContent, problem: UndecodableFile) -> FileOutcome:
        report = FileReport(name=row.name, problem=problem.stored)
        add_redaction(report, content.redaction, ())
        before = repository.failed_file(self.db, self.participant.id, row) if row.decided_at is None else None
        if before is not None:
            return self._failed_before(name, row, before, report, problem)
        row.status = "failed"
        store_reports(row, [report])
        return FileOutcome(name, row, [report], for_sender=problem.for_sender)

    def _failed_before(self, name: str, row: UploadFile, before: UploadFile, report: FileReport, problem: UndecodableFile) -> FileOutcome:
        """Report that the same bytes were of no use before, and still are: they are stored once."""
        report.understood.append(f"The same bytes came before, as file {before.id} in upload {before.upload_id}; they are kept once.")
        sealed, kept = row.quarantine_sha256, before.quarantine_sha256
        before.report = {**(before.report or {}), **lasting(row)}
        if sealed is not None and kept is not None and not files.is_whole(kept):
            before.quarantine_sha256, sealed = sealed, kept
            before.stored_sha256 = before.quarantine_sha256 if before.stored_sha256 == kept else before.stored_sha256
        self.db.delete(row)
        store_reports(before, [report])
        self._forget(sealed)
        return FileOutcome(name, before, [report], duplicate=True, same_bytes=True, for_sender=problem.for_sender)


def _forget_begin(row: UploadFile) -> None:
    row.report = {**row.report, BEGUN: row.report.get(BEGUN, 1) - 1}


def _harmless_name(name: str, kind: str) -> str:
    """Make a name harmless, since names of files carry names of people. The kind stays, and the ending where it is a known one."""
    return kind + cleaned_suffix(name)
