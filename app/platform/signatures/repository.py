"""Every query of signatures."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.audit import Signature


def signatures_of(db: Session, kind: str, subject_id: int) -> Sequence[Signature]:
    """List every signature under one thing, newest first."""
    mine = (Signature.subject_kind == kind) & (Signature.subject_id == subject_id)
    return db.scalars(select(Signature).where(mine).order_by(Signature.id.desc())).all()


def newest_of_each(db: Session, kind: str, subject_ids: Collection[int]) -> dict[int, Signature]:
    """Find the newest signature under each of several things of a kind; unsigned ones are omitted."""
    if not subject_ids:
        return {}
    mine = (Signature.subject_kind == kind) & Signature.subject_id.in_(subject_ids)
    return {row.subject_id: row for row in db.scalars(select(Signature).where(mine).order_by(Signature.id))}


def contents(db: Session) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Yield number, hash and content of every signature."""
    rows = db.execute(select(Signature.id, Signature.sha256, Signature.content).order_by(Signature.id).execution_options(yield_per=100))
    for row in rows:
        yield row[0], row[1], row[2]
