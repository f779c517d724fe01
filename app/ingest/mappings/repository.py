"""Every query of column mappings."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.errors import NotFound
from app.tables.accounts import Study
from app.tables.uploads import ColumnMapping


def versions(db: Session, study_id: int) -> Sequence[ColumnMapping]:
    """List every version of every mapping of a study, newest first."""
    return db.scalars(select(ColumnMapping).where(ColumnMapping.study_id == study_id).order_by(ColumnMapping.id.desc())).all()


def present(db: Session, study_id: int) -> list[ColumnMapping]:
    """List the mappings by which tables of a study are read now, oldest first."""
    newest: dict[str, ColumnMapping] = {}
    for row in versions(db, study_id):
        newest.setdefault(row.header, row)
    return sorted((row for row in newest.values() if not row.removed), key=lambda row: row.id)


def newest(db: Session, study_id: int, header: str) -> ColumnMapping | None:
    """Find the newest version of a mapping, removed or not; others who change mappings of the study wait until the transaction ends."""
    db.execute(select(func.pg_advisory_xact_lock(func.hashtext("column_mapping"), study_id)))
    same = (ColumnMapping.study_id == study_id) & (ColumnMapping.header == header)
    return db.scalar(select(ColumnMapping).where(same).order_by(ColumnMapping.version.desc()).limit(1))


def mapping(db: Session, mapping_id: int, caller: Caller) -> ColumnMapping:
    """Find a version of a mapping. Raises NotFound."""
    row = db.get(ColumnMapping, mapping_id)
    if row is None or not caller.may(can.READ, row.study_id):
        raise NotFound(f"There is no column mapping {mapping_id}, or you have no access to it.")
    return row


def study_of(db: Session, code: str, caller: Caller) -> Study:
    """Find the study of a code. Raises NotFound."""
    row = db.scalar(select(Study).where(Study.code == code))
    if row is None or not caller.may(can.READ, row.id):
        raise NotFound(f"There is no study {code}, or you have no access to it.")
    return row
