"""Queries of doses, within what the caller may read."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.platform.errors import NotFound
from app.study.repository import visit
from app.tables.visits import Dose, Visit


def dose_with_visit(db: Session, dose_id: int, caller: Caller) -> tuple[Dose, Visit]:
    """A dose that was not removed, and its visit. Raises NotFound."""
    row = db.scalar(select(Dose).where(Dose.id == dose_id, Dose.removed_at.is_(None)))
    gone = NotFound(f"There is no dose {dose_id}, or you have no access to it.")
    if row is None:
        raise gone
    try:
        return row, visit(db, row.visit_id, caller)
    except NotFound:
        raise gone from None
