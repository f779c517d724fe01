"""Rules of column mappings: a person who saw a preview says what the columns of a table are, and the study reads such tables so."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.ingest import repository as uploads
from app.ingest import wording
from app.ingest.mappings import repository, rules
from app.ingest.mappings.schemas import MappingIn
from app.ingest.quarantine import service as quarantine
from app.ingest.uploads.service import FileOutcome
from app.platform.database import set_reason
from app.platform.errors import Conflict, Forbidden, Invalid, NotFound
from app.study import access
from app.tables.participants import Participant
from app.tables.uploads import ColumnMapping, UploadFile
from ml.formats.tables.mapping import TableMapping


@dataclass(frozen=True)
class WaitingTable:
    """A table that waits for a mapping; `known` is the study's present one for its header, which could not read it."""

    file: UploadFile
    participant: Participant
    preview: dict[str, Any]
    known: ColumnMapping | None


@dataclass
class Applied:
    """A stored mapping, the tables that were read by it, and the waiting ones of the same upload that it does not read."""

    mapping: ColumnMapping
    outcomes: list[FileOutcome] = field(default_factory=list)
    waiting: list[int] = field(default_factory=list)


def waiting_table(db: Session, file_id: int, caller: Caller, lock: bool = False) -> WaitingTable:
    """Find a table that waits for a mapping, for those who may upload.

    Raises:
        NotFound: no such file, or it waits for none. Forbidden: the caller may not upload.
    """
    file, participant = uploads.upload_file(db, file_id, caller, lock)
    access.require(caller, can.UPLOAD, participant)
    if file.preview is None:
        raise NotFound(f"File {file.id} waits for no column mapping.", f"See what became of it: upload {file.upload_id}.")
    headers = {line["header"] for line in file.preview["lines"]}
    known = (m for m in repository.present(db, participant.site.study_id) if m.header in headers)
    return WaitingTable(file, participant, file.preview, next(known, None))


def read_by(db: Session, file_id: int, wanted: MappingIn, caller: Caller) -> Applied:
    """Store a mapping for a waiting table's header, and read by it that table and those of the same upload that have this header.

    Commits once the table was read; where it cannot be read so, nothing is stored and it waits on.

    Raises:
        Invalid: a field is wrong, or the table cannot be read so, and why. Others as `waiting_table`.
    """
    table = waiting_table(db, file_id, caller, lock=True)
    row = _store(db, table, rules.mapping_of(wanted, table.preview), wanted, caller)
    why = wording.read_by_mapping(row)
    applied = Applied(row, quarantine.read_held(db, table.file, table.participant, why, caller).files)
    for other in uploads.files_of_upload(db, table.file.upload_id):
        if other.preview is None or row.header not in {line["header"] for line in other.preview["lines"]}:
            continue
        try:
            applied.outcomes += quarantine.read_held(db, other, table.participant, why, caller).files
        except (Conflict, Invalid):
            # The mapping is stored and has read the first table. An error in another table is reported where that one is read; it waits on.
            applied.waiting.append(other.id)
    return applied


def _store(db: Session, table: WaitingTable, mapping: TableMapping, wanted: MappingIn, caller: Caller) -> ColumnMapping:
    """Store the next version of the mapping of a header, not committed."""
    study_id = table.participant.site.study_id
    before = repository.newest(db, study_id, mapping.header)
    names = next(line["cells"] for line in table.preview["lines"] if line["header"] == mapping.header)
    row = ColumnMapping(
        study_id=study_id,
        header=mapping.header,
        version=before.version + 1 if before else 1,
        name=wanted.name,
        mapping=mapping.to_json(),
        labels={str(c.number): names[c.number - 1] for c in mapping.columns},
        created_by=caller.label,
        reason=wanted.reason or None,
    )
    if wanted.reason:
        set_reason(db, wanted.reason)
    db.add(row)
    db.flush()
    return row


def may_remove(caller: Caller, study_id: int, created_by: str) -> bool:
    """Decide whether the caller may end a mapping of a study: users who upload at all of its sites may, and its author."""
    everywhere = any(g.study_id == study_id and g.site_id is None for g in caller.grants_with(can.UPLOAD))
    return caller.may(can.UPLOAD, study_id) and (caller.is_system or everywhere or created_by == caller.label)


def remove(db: Session, mapping_id: int, reason: str, caller: Caller) -> ColumnMapping:
    """End a mapping: what was read by it stays, the next table with its header asks again. Not committed.

    Raises:
        NotFound: no such mapping. Forbidden: the caller may not upload in the study. Forbidden too: the caller works at one site alone and
            has not made it, since tables of every site are read by it. Conflict: it is not the present version.
    """
    row = repository.mapping(db, mapping_id, caller)
    caller.require(can.UPLOAD, row.study_id)
    if not may_remove(caller, row.study_id, row.created_by):
        raise Forbidden(
            "Tables of every site of the study are read by this column mapping, and you work at one of them.",
            f"Ask a person who works at all sites of the study, or {row.created_by}, who made it.",
        )
    newest = repository.newest(db, row.study_id, row.header)
    if newest is None or newest.id != row.id or row.removed:
        raise Conflict(f"Column mapping {row.id} is not in force any more.", "Load the list again.")
    if not reason.strip():
        raise Invalid("Removing a column mapping needs a reason.", "Say why.", field="reason")
    set_reason(db, reason.strip())
    ended = ColumnMapping(
        study_id=row.study_id,
        header=row.header,
        version=row.version + 1,
        name=row.name,
        mapping=row.mapping,
        labels=row.labels,
        removed=True,
        created_by=caller.label,
        reason=reason.strip(),
    )
    db.add(ended)
    db.flush()
    return ended
