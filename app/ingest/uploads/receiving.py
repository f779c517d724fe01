"""One file of an upload on its way in: safe on disk, identity out, decoded, and known again by its bytes or its content.

Which sessions come out is decided when all files of the upload are in; see `app.ingest.uploads.service`.
"""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import cast

import structlog
from sqlalchemy.orm import Session

from app.ingest import encryption, repository, wording
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
from ml.formats.rcs import find_sessions
from ml.formats.recording import DecodedFile, FileReport, GraspLog, Problem, TraceLog, TraceSource, UndecodableFile
from ml.formats.redaction_record import REDACTOR_VERSION, Redaction
from ml.formats.tables.numbers import unit_name

log = structlog.get_logger()

EMPTY = UndecodableFile("the file is empty", "0 bytes", "Send the file again from where it was recorded; an empty one is not content.")
CUT_SHORT = UndecodableFile(
    "the service was stopped while it took this file", "file", "Read it again on the page of the quarantine, or send it again."
)
LETHAL = 2
"""So many times a process may end while it reads a file, or makes sessions of an upload; then that is not tried again by itself."""
ENDED_THE_SERVICE = UndecodableFile(
    f"the service ended {LETHAL} times while it read this file: it may ask for more memory than there is",
    "file",
    "Look at it on the page of the quarantine. Send it again with what is wrong mended, or read it again when the service was mended.",
)
RESUMED = "The service was stopped while it read this file and has read it from the kept bytes since; what was removed is not listed again."
BEGUN = "begun"
"""Member of a file's report: how often reading it was begun, while it is being read."""
ASIDE = "aside_sha256"
"""Member of a file's report: hash of its bytes without identity, where these are what the quarantine holds, and not the original."""
TABLES = ("csv", "parquet", "control_log")
MEDIA_TYPE = "application/octet-stream"


@dataclass(frozen=True)
class BetaStated:
    """What the sender says of a table: unit and source (as in the settings) of its beta, and the unit of its LFP."""

    unit: str | None = None
    source: str | None = None
    lfp_unit: str | None = None


@dataclass
class FileOutcome:
    """What became of one file. `name` is what the sender called it; it and `for_sender`, the problem in the file's own words, go back
    to the sender and are never stored.

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
    for_sender: Problem | None = None
    recordings: list[Recording] = field(default_factory=list)
    grasps: Sequence[GraspLog] = ()

    @property
    def reports_for_sender(self) -> list[FileReport]:
        """The reports, naming the file as the sender does, and quoting it where that shows what is wrong."""
        own = [replace(r, name=self.name) if r.name == self.row.name else r for r in self.reports]
        return [replace(r, problem=self.for_sender) if r.problem is not None and self.for_sender is not None else r for r in own]


@dataclass(frozen=True)
class StoredContent:
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
            with files.received(one.stream, limit_mb * 1024 * 1024) as (raw, sha256, size):
                if known := self._known(name, sha256):
                    return known
                content = self._store(raw) if size else StoredContent("unreadable", None, None, Redaction(), EMPTY)
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
            report={BEGUN: 1},
        )
        self.db.add(row)
        self.db.commit()  # the bytes are safe from here on, whatever the decoder does with them
        return self.decode(name, row, content)

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

    def resume(self, row: UploadFile) -> FileOutcome:
        """Go on with a file of an upload that was interrupted: decode it where that is still to do, else as it was left."""
        if row.status != "received":
            return FileOutcome(row.name, row, stored_reports(row), recordings=self._recordings(row))
        sealed = row.stored_sha256 is None or row.stored_sha256 == row.quarantine_sha256
        if not sealed and row.report.get(BEGUN, 0) >= LETHAL:
            return self._put_aside(row)
        # committed before the file is read, so that it is known whom to blame when that ends the process
        row.report = {BEGUN: row.report.get(BEGUN, 0) + 1}
        self.db.commit()
        outcome = self.decode(
            row.name, row, StoredContent(row.kind, row.stored_sha256, row.quarantine_sha256, Redaction(), CUT_SHORT if sealed else None)
        )
        if not outcome.same_bytes:
            outcome.reports[0].understood.append(RESUMED)
            store_reports(row, outcome.reports, known_recordings(row))
        return outcome

    def _put_aside(self, row: UploadFile) -> FileOutcome:
        """Into quarantine with a file that ends the process which reads it; a person decides on it there."""
        assert row.stored_sha256 is not None
        log.error("file put aside: reading it ended the service", upload_file=row.id, times=row.report[BEGUN])
        stored = row.stored_sha256
        if row.quarantine_sha256 is None:
            row.quarantine_sha256, row.report = self._seal(files.path_of(stored)), {ASIDE: stored}
        return self._failed(row.name, row, StoredContent(row.kind, stored, row.quarantine_sha256, Redaction(), None), ENDED_THE_SERVICE)

    def _store(self, raw: Path) -> StoredContent:
        """Store a file without identity; what could not be parsed, and so not be cleaned, is kept encrypted.

        A table is cleaned by reading it with the participant's options: one that cannot be decoded is kept encrypted too.
        """
        clean = files.draft_path()
        try:
            kind = formats.sniff(raw)
            redaction = formats.redact(raw, clean, kind, get_settings().secret("pseudonyms"), self.options)
        except UndecodableFile as error:
            return self._quarantined(raw, clean, error)
        except Exception as fault:
            # a fault of ours must not take the other files of the upload with it, and what it left behind may still name a person
            log.exception("file could not be cleaned", upload=self.upload.id, fault=repr(fault))
            hint = f"It is kept encrypted; tell your administrator: upload {self.upload.id}."
            return self._quarantined(
                raw, clean, UndecodableFile("the service failed while it took identity out of this file", "file", hint)
            )
        sealed = self._seal(raw) if redaction.unreadable else None
        return StoredContent(kind, files.store(self.db, clean, MEDIA_TYPE).sha256, sealed, redaction, None)

    def _quarantined(self, raw: Path, clean: Path, problem: UndecodableFile) -> StoredContent:
        clean.unlink(missing_ok=True)
        left_out = _left_out(raw, self.options.archive)
        sealed = self._seal(raw)
        return StoredContent("unreadable", sealed, sealed, Redaction(ignored=left_out), problem)

    def _seal(self, raw: Path) -> str:
        return files.store(self.db, encryption.encrypt(raw), MEDIA_TYPE).sha256

    def decode(self, name: str, row: UploadFile, content: StoredContent) -> FileOutcome:
        """Decode a stored file; whatever is wrong with it becomes its report."""
        if content.problem is not None or content.stored_sha256 is None:
            return self._failed(name, row, content, content.problem or CUT_SHORT)
        try:
            repository.lock_participant(self.db, self.participant.id)
            # asked again under the lock: somebody may have sent the same bytes meanwhile
            if known := self._known(name, row.original_sha256):
                self.db.delete(row)
                self.db.commit()
                return known
            decoded = formats.decode(files.path_of(content.stored_sha256), cast(FileKind, content.kind), self.options, name=row.name)
            if content.kind in TABLES:
                decoded = self._name_beta(decoded)
            stored = recordings.store(self.db, self.participant, row, decoded.recordings)
            tremor = outcomes_intake.take_tremor(self.db, row, decoded.tremor)
        except UndecodableFile as error:
            self.db.rollback()
            return self._failed(name, row, content, error)
        except Exception as fault:
            # a fault of ours must not take the other files of the upload with it; the bytes are safe for a better decoder
            self.db.rollback()
            log.exception("decoder failed", upload_file=row.id, kind=content.kind, fault=repr(fault))
            ours = UndecodableFile("the decoder failed on this file", "file", f"Tell your administrator: upload file {row.id}.")
            return self._failed(name, row, content, ours)
        reports = list(decoded.reports)
        _add_redaction(reports[0], content.redaction, tremor)
        row.status = "decoded"
        store_reports(row, reports, [r.id for r in stored.known], content.redaction.unreadable)
        self.db.commit()
        all_known = bool(stored.known) and not stored.fresh
        return FileOutcome(name, row, reports, all_known, recordings=[*stored.known, *stored.fresh], grasps=decoded.grasps)

    def _failed(self, name: str, row: UploadFile, content: StoredContent, problem: UndecodableFile) -> FileOutcome:
        report = FileReport(name=row.name, problem=problem.stored)
        _add_redaction(report, content.redaction, ())
        before = repository.failed_file(self.db, self.participant.id, row) if row.decided_at is None else None
        if before is not None:
            return self._failed_before(name, row, before, report, problem)
        row.status = "failed"
        store_reports(row, [report])
        self.db.commit()
        return FileOutcome(name, row, [report], for_sender=problem.for_sender)

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
        return FileOutcome(name, before, [report], duplicate=True, same_bytes=True, for_sender=problem.for_sender)

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
    source_from = _stated_by(beta.source, settings.beta_source)
    for trace in (t for r in decoded.recordings for t in r.traces if _stated_by_a_person(t)):
        in_header = trace.details["unit_from"] == "header"
        unit_from = "as the file's header says" if in_header else _stated_by(beta.unit, settings.beta_unit)
        report.understood.append(f"beta: unit '{trace.unit}' {unit_from}, source '{source}' {source_from}")
        if in_header and beta.unit and unit_name(beta.unit) != trace.unit:
            stated = unit_name(beta.unit)
            report.flagged.append(f"the file's header gives beta in '{trace.unit}', the upload says '{stated}': the header was taken")
    return replace(decoded, recordings=named)


def _stated_by_a_person(trace: TraceLog) -> bool:
    """Whether a trace is the beta column of a table, whose source nobody but a person can tell."""
    return trace.stream == "beta" and trace.source == "table"


def store_reports(
    row: UploadFile, reports: Sequence[FileReport], known: Sequence[int] = (), unreadable: Sequence[str] | None = None
) -> None:
    """Store a file's reports, which of its recordings came before in other files, and which members could not be read (None: as stored)."""
    found = unreadable_members(row) if unreadable is None else list(unreadable)
    aside = {ASIDE: row.report[ASIDE]} if ASIDE in (row.report or {}) else {}
    row.report = {"reports": [asdict(r) for r in reports], "known_recordings": list(known), "unreadable": found, **aside}


def stored_reports(row: UploadFile) -> list[FileReport]:
    """The reports of a file as they were stored."""
    # a copy: sentences appended to the stored lists themselves would not be seen as a change, and not be written
    stored = deepcopy(row.report.get("reports", []))
    return [FileReport(**{**r, "problem": _stored_problem(r["problem"])}) for r in stored]


def _stored_problem(stored: Mapping[str, str] | None) -> Problem | None:
    """The problem of a stored report; version 0.1.0 called its hint `mend`."""
    if stored is None:
        return None
    return Problem(stored["what"], stored["where"], stored["hint"] if "hint" in stored else stored["mend"])


def unreadable_members(row: UploadFile) -> list[str]:
    """Members of a stored file that could not be read, and why; in reports of version 0.1.0 they stand among the flags, behind a prefix."""
    report = row.report or {}
    found: list[str] | None = report.get("unreadable")
    if found is not None:
        return found
    prefix = "kept encrypted, because it could not be read: "
    return [s.removeprefix(prefix) for r in stored_reports(row) for s in r.flagged if s.startswith(prefix)]


def known_recordings(row: UploadFile) -> list[int]:
    """Recordings of a file that another file had brought before."""
    found: list[int] = row.report.get("known_recordings", [])
    return found


def _stated_by(by_upload: str | None, by_settings: str | None) -> str:
    """Who stated a unit or a source."""
    if by_upload:
        return "as stated with the upload"
    return "as the participant's settings say" if by_settings else "because nobody stated one"


def _add_redaction(report: FileReport, redaction: Redaction, notes: Sequence[str]) -> None:
    """Add to a report what cleaning the file found, and what was made of it."""
    for ours, found in ((report.removed, redaction.removed), (report.repaired, redaction.repaired), (report.ignored, redaction.ignored)):
        ours.extend(sentence for sentence in found if sentence not in ours)
    report.flagged.extend(wording.unreadable(redaction.unreadable))
    report.understood.extend(notes)


def _left_out(path: Path, limits: ArchiveLimits) -> list[str]:
    """Why members of an archive of no use were left out, counted, without their names, which may identify a person."""
    if not zipfile.is_zipfile(path):
        return []
    listing = FileReport("archive")
    try:
        with ZipFiles(path, limits) as members:
            find_sessions(members, listing)
            reasons = Counter(member.reason for member in members.left_out)
    except UndecodableFile:
        return []  # the problem itself says what is wrong with the archive
    return [*listing.ignored, *(f"{n} file{'s' if n > 1 else ''}: {reason}" for reason, n in sorted(reasons.items()))]


def _harmless_name(name: str, kind: str) -> str:
    """Names of files carry names of people; what stays is the kind and the ending."""
    suffix = Path(name).suffix.lower()
    return f"{kind}{suffix if len(suffix) <= 9 and suffix[1:].isalnum() else ''}"
