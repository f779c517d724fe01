"""The audit trail as a table: a line per row of it, in words and with what changed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sqlalchemy import ColumnElement
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.overview.trail import repository
from app.overview.trail.acts import Line, lines
from app.overview.trail.schemas import TrailFilter
from app.platform.audit import record
from app.platform.web.csv_files import in_pieces

COLUMNS = ("number", "time_utc", "who", "what", "reason", "action", "table", "row", "changes", "request")


def as_csv(db: Session, within: ColumnElement[bool], wanted: TrailFilter, caller: Caller) -> Iterator[str]:
    """The rows that match, newest first, a piece at a time, so that a long trail needs no more memory than a short one.

    The export is recorded before the first piece. The caller commits.
    """
    stated = wanted.stated()
    if "words" in stated:
        stated["words"] = "stated"  # what somebody types may be a name
    record(db, "export", "audit", "trail", {"filters": stated})
    return in_pieces(COLUMNS, _batches(db, within, wanted, caller))


def _batches(db: Session, within: ColumnElement[bool], wanted: TrailFilter, caller: Caller) -> Iterator[list[Sequence[object]]]:
    for events in repository.batches(db, within, wanted):
        yield [_row(line) for line in lines(db, events, caller)]
        db.expunge_all()  # what was written is not kept in memory


def _row(line: Line) -> Sequence[object]:
    e = line.event
    changed = "; ".join(f"{name}: {_side(before)} -> {_side(after)}" for name, before, after in line.changes)
    return (e.id, e.at.isoformat(), e.actor, line.said, line.reason, e.action, e.entity, e.entity_id, changed, e.request_id)


def _side(value: str | None) -> str:
    return "-" if value is None else value
