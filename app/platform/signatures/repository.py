"""Every query of signatures."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.platform.signatures.models import Signature


def signatures_of(db: Session, kind: str, subject_id: int) -> Sequence[Signature]:
    """Every signature under one thing, newest first."""
    mine = (Signature.subject_kind == kind) & (Signature.subject_id == subject_id)
    return db.scalars(select(Signature).where(mine).order_by(Signature.id.desc())).all()


def newest_of_each(db: Session, kind: str, subject_ids: Collection[int]) -> dict[int, Signature]:
    """The newest signature under each of several things of a kind; what nobody signed is left out."""
    if not subject_ids:
        return {}
    mine = (Signature.subject_kind == kind) & Signature.subject_id.in_(subject_ids)
    return {row.subject_id: row for row in db.scalars(select(Signature).where(mine).order_by(Signature.id))}
