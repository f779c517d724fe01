"""Every query of signatures."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.platform.signatures.models import Signature


def signatures_of(db: Session, kind: str, subject_id: int) -> Sequence[Signature]:
    """Every signature under one thing, newest first."""
    mine = (Signature.subject_kind == kind) & (Signature.subject_id == subject_id)
    return db.scalars(select(Signature).where(mine).order_by(Signature.id.desc())).all()
