"""Accepted false times of the trail: `betaloop audit accept` writes a row of the trail, and `verify` separates them from breaks.

A clock that went fast leaves rows with future times. The first row after it was set right is named for ever, since nothing in the trail is
changed. What was accepted stays listed, with who, when and why; no other kind of break can be accepted.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.platform.audit.breaks import Break
from app.platform.audit.trail import record
from app.platform.database import set_reason
from app.tables.audit import AuditEvent

ACCEPT, ENTITY = "accept", "audit_event"


@dataclass(frozen=True)
class Accepted:
    """A finding that was looked into, by whom, when and why."""

    found: Break
    by: str
    at: datetime
    reason: str


def accept(db: Session, event_id: int, reason: str) -> None:
    """Record in the trail that a person has looked into the time of one of its rows. The caller commits."""
    set_reason(db, reason)
    record(db, ACCEPT, ENTITY, event_id)


def acceptances(db: Session) -> dict[int, AuditEvent]:
    """Find the newest row that accepts each row's time, by the number of the row; none that came before what it accepts."""
    rows = db.scalars(select(AuditEvent).where(AuditEvent.entity == ENTITY, AuditEvent.action == ACCEPT).order_by(AuditEvent.id))
    return {int(e.entity_id): e for e in rows if e.entity_id.isdecimal() and e.id > int(e.entity_id)}
