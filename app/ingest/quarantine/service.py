"""Files kept encrypted because they could not be read, and so not be cleaned: a person reviews them, releases them, or discards them.

Every function here commits on its own: bytes are erased only after the decision is safe. The file's row and the audit trail record who
decided what, when and why.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from cryptography.fernet import InvalidToken
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.ingest import encryption, repository
from app.ingest.mappings import repository as mappings
from app.ingest.stated_beta import BetaStated, decode_options
from app.ingest.uploads import reading, service
from app.ingest.uploads.receiving import Receiver, StoredContent
from app.ingest.uploads.reports import ASIDE
from app.ingest.uploads.service import UploadOutcome
from app.platform import files
from app.platform.audit import record
from app.platform.database import end_reading, now, set_reason
from app.platform.errors import Conflict, Invalid
from app.platform.raw_bytes import RawFile, raw_file
from app.study import access
from app.tables.participants import Participant
from app.tables.uploads import PREVIEW, StoredFile, UploadFile
from ml.formats import REDACTOR_VERSION, UndecodableFile


def review(db: Session, file_id: int, caller: Caller) -> Iterator[bytes]:
    """Yield the original bytes, piece by piece, for a person to look at; the audit trail records who did. They may identify the
    participant.

    Raises:
        Conflict: the file is not, or no longer, in quarantine.
    """
    file, _ = _held(db, file_id, caller)
    with ExitStack() as held:
        original = held.enter_context(_original(file))  # all of it is checked before the first byte leaves
        file.reviewed_by, file.reviewed_at = caller.label, now()
        record(db, "export", "upload_file", file.id)
        db.commit()
        return _pieces(original, held.pop_all())


def read_again(db: Session, file_id: int, reason: str, caller: Caller) -> UploadOutcome:
    """Release a file to the present decoder; where all of it can be read now, the encrypted original goes.

    Raises:
        Conflict: not in quarantine, the same bytes were decoded meanwhile, the participant has withdrawn, or the site or study has ended.
        Invalid: still unreadable, and why.
    """
    file, participant = _held(db, file_id, caller)
    return read_held(db, file, participant, reason, caller)


def read_held(db: Session, file: UploadFile, participant: Participant, reason: str, caller: Caller) -> UploadOutcome:
    """Read a quarantined file, as `read_again` does, for users who may decide that it can be read."""
    # what is read of it is new data, although its bytes came before the end
    access.refuse_withdrawn(participant)
    access.refuse_ended(participant.site)
    if file.status == "failed" and (known := repository.decoded_file(db, participant.id, file.original_sha256)) is not None:
        raise Conflict(f"The same bytes were read as file {known.id} of upload {known.upload_id}.", "Discard this copy.")
    upload = repository.upload(db, file.upload_id, caller)[0]
    said = upload.stated
    beta = BetaStated(said.get("unit"), said.get("source"), said.get("lfp_unit"))
    options = decode_options(db, participant, beta)
    clean = files.draft_path()
    known_mappings = mappings.present(db, participant.site.study_id)
    ways = [m.as_mapping for m in known_mappings]
    with _original(file) as original:
        try:
            found = reading.twice(lambda: reading.clean(original, clean, options, mappings=ways))
            if found.problem is not None:
                _keep_preview(db, file, found.preview)
                raise found.problem
        except BaseException as error:
            clean.unlink(missing_ok=True)
            if not isinstance(error, UndecodableFile):
                raise
            raise Invalid(f"It still cannot be read: {error.stored_what} ({error.stored_where}).", error.hint) from error
    kind, redaction, sealed = found.kind, found.redaction, file.quarantine_sha256
    stored = _keep(db, file, clean)
    file.kind, file.stored_sha256, file.redactor_version = kind, stored, REDACTOR_VERSION
    file.column_mapping = known_mappings[found.mapping] if found.mapping is not None else None
    _decide(db, file, reason, caller)
    db.commit()
    content = StoredContent(kind, stored, sealed if redaction.unreadable else None, redaction, None)
    outcome = UploadOutcome(upload, participant, [Receiver(db, participant, upload, options, beta).decode(file.name, file, content)])
    if file.status == "decoded":
        stated = service.as_stated(db, participant, said)
        service.make_sessions(db, outcome, stated)
        service.attach_grasps_of(db, outcome, stated)
        upload.status = "decoded"
        db.commit()  # what was read is safe before the original goes
        if not redaction.unreadable:
            _erase(db, file)
    return outcome


def _keep_preview(db: Session, file: UploadFile, preview: dict[str, Any] | None) -> None:
    """Keep what may be shown of a table that came before there were column mappings, so that one can be stated. Commits."""
    if preview is not None and PREVIEW not in file.report:
        file.report = {**file.report, PREVIEW: preview}
        db.commit()


def release_as_is(db: Session, file_id: int, reason: str, caller: Caller) -> UploadFile:
    """Store a reviewed file as it came, decrypted. Raises Conflict: not in quarantine, or not reviewed."""
    file, _ = _held(db, file_id, caller)
    if file.reviewed_at is None:
        raise Conflict(f"No person has looked at file {file.id} yet.", "Review its content first: it may name the participant.")
    with _original(file) as original:
        draft = files.draft_path()
        try:
            with original.open() as source, draft.open("wb") as out:
                shutil.copyfileobj(source, out, files.CHUNK)
            file.released_sha256 = _keep(db, file, draft)
        finally:
            draft.unlink(missing_ok=True)
    file.status = "released" if file.status == "failed" else file.status
    _decide(db, file, reason, caller)
    db.commit()  # what is released is safe before the original goes
    _erase(db, file)
    return file


def discard(db: Session, file_id: int, reason: str, caller: Caller) -> UploadFile:
    """Erase the bytes for good; the row says what there was. Raises Conflict: not in quarantine."""
    file, _ = _held(db, file_id, caller)
    file.status = "discarded" if file.status == "failed" else file.status
    _decide(db, file, reason, caller)
    _erase(db, file)
    return file


def _held(db: Session, file_id: int, caller: Caller) -> tuple[UploadFile, Participant]:
    file, participant = repository.upload_file(db, file_id, caller, lock=True)
    access.require(caller, can.DECIDE_QUARANTINE, participant)
    if file.quarantine_sha256 is None:
        done = f": {file.decided_by} decided on it" if file.decided_by else ""
        raise Conflict(f"File {file.id} is not in quarantine{done}.", "Load the page again.")
    return file, participant


def _keep(db: Session, file: UploadFile, draft: Path) -> str:
    """Store what was made of a file, with no transaction open while it travels. Raises Conflict: it was decided on meanwhile."""
    before = (file.status, file.quarantine_sha256)
    end_reading(db)
    kept = files.keep_bytes(draft)
    db.refresh(file, with_for_update=True)
    if (file.status, file.quarantine_sha256) != before:
        raise Conflict(f"File {file.id} was decided on meanwhile.", "Load the page again.")
    return files.record(db, kept).sha256


def _decide(db: Session, file: UploadFile, reason: str, caller: Caller) -> None:
    reason = reason.strip()
    if not reason:
        raise Invalid("A decision on a quarantined file needs a reason.", "Say why.", field="reason")
    set_reason(db, reason)
    file.decided_by, file.decided_at, file.decision_reason = caller.label, now(), reason
    db.flush()


def _pieces(original: RawFile, held: ExitStack) -> Iterator[bytes]:
    with held, original.open() as source:
        while piece := source.read(files.CHUNK):
            yield piece


@contextmanager
def _original(file: UploadFile) -> Iterator[RawFile]:
    """Open the original, encrypted as when it came, with a key that goes when it was used.

    Raises:
        Conflict: its bytes cannot be decrypted, or are not those that came.
    """
    assert file.quarantine_sha256 is not None
    with raw_file() as (out, raw):
        try:
            with files.borrowed(file.quarantine_sha256) as sealed:
                for chunk in encryption.decrypt(sealed):
                    out.write(chunk)
        except (InvalidToken, OSError) as error:
            hint = "Restore the data folder, with its keys, from a backup."
            raise Conflict(f"The encrypted bytes of file {file.id} are missing or damaged.", hint) from error
        if raw.sha256() != file.report.get(ASIDE, file.original_sha256):
            raise Conflict(f"The bytes of file {file.id} are not those that came: their hash differs.", "Restore a backup.")
        yield raw


def _erase(db: Session, file: UploadFile) -> None:
    """Remove the encrypted bytes, then forget them. Commits.

    The order matters. Where the store is away, the row still names the bytes, and the decision can be made again. In the other order they
    would never be removed. What was made of them is committed before.
    """
    db.refresh(file, ["quarantine_sha256"], with_for_update=True)
    sealed = file.quarantine_sha256
    if sealed is None:
        return  # another person has decided as well since that commit
    files.remove(sealed)
    file.quarantine_sha256 = None
    file.report = {name: value for name, value in file.report.items() if name != PREVIEW}
    if file.stored_sha256 == sealed:
        file.stored_sha256 = None
    db.flush()
    db.delete(db.get_one(StoredFile, sealed))
    db.commit()
