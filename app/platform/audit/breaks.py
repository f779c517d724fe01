"""Breaks of the trail, of what writes it, and of the rows that it covers; and the sentences about them.

A clock that went fast leaves rows with future times. The first row after it was set right is reported for ever, since nothing in the trail
changes. `betaloop audit accept` records who accepted such a time, when and why; no other kind of break can be accepted.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.platform.audit.trail import record
from app.platform.database import set_reason
from app.tables.audit import AuditEvent

MOST_BREAKS = 100
"""After so many the rest is not looked for: the trail is broken, and one wants to know where it begins."""


class BreakKind(StrEnum):
    """Kind of a break: of a link or a row of the trail, of what writes it, or of a row of an audited table."""

    EDITED = "edited"
    REMOVED = "removed"
    ADDED = "added"
    GAP = "gap"
    REWRITTEN = "rewritten"
    FORGED_SEAL = "forged_seal"
    CUT_OFF = "cut_off"
    TRIGGER_OFF = "trigger_off"
    TRIGGER_UNKNOWN = "trigger_unknown"
    FUNCTION_CHANGED = "function_changed"
    DEFAULT_CHANGED = "default_changed"
    BACKDATED = "backdated"
    SIGNATURE_CHANGED = "signature_changed"
    ROW_ALTERED = "row_altered"
    ROW_REMOVED = "row_removed"
    ROW_ADDED = "row_added"


@dataclass(frozen=True)
class Break:
    """One break, with what applies to it.

    Attributes:
        position: place in the chain. event_id: number of the trail's row. table: the audited one, or that of a wrong trigger.
        row: the key of a row of that table. columns: those that differ. name: of a trigger, a rule or a function.
    """

    kind: BreakKind
    position: int | None = None
    event_id: int | None = None
    table: str | None = None
    row: str | None = None
    columns: tuple[str, ...] = ()
    name: str | None = None


def sentence(b: Break) -> str:
    """Describe a break in words."""
    where = f"table {b.table}, row {b.row}"
    return {
        BreakKind.EDITED: f"link {b.position}: row {b.event_id} is not what was written",
        BreakKind.REMOVED: f"link {b.position}: row {b.event_id} was taken out",
        BreakKind.ADDED: f"row {b.event_id} was put in past the chain",
        BreakKind.GAP: f"link {b.position} is missing",
        BreakKind.REWRITTEN: f"link {b.position} is not the one that was sealed: the chain was computed anew",
        BreakKind.FORGED_SEAL: f"the seal of link {b.position} was not made with this installation's key",
        BreakKind.CUT_OFF: f"link {b.position} was sealed and is gone: the end of the trail was cut off",
        BreakKind.TRIGGER_OFF: f"table {b.table}: its trigger {b.name} is missing, switched off, or not the one that betaloop made",
        BreakKind.TRIGGER_UNKNOWN: f"table {b.table}: betaloop made no trigger or rule {b.name}, which may keep changes from the trail",
        BreakKind.FUNCTION_CHANGED: f"function {b.name}, on which the trail rests, is missing or not the one that betaloop made",
        BreakKind.DEFAULT_CHANGED: f"table {b.table}: what stands in column {', '.join(b.columns)} by default is not what betaloop made",
        BreakKind.BACKDATED: f"link {b.position}: the time of row {b.event_id} lies more than a day before that of an earlier one: "
        "the clock of the database was fast until then, or this row was given a false time",
        BreakKind.SIGNATURE_CHANGED: f"signature {b.row}: its content is not what was signed",
        BreakKind.ROW_ALTERED: f"{where}: {', '.join(b.columns)} changed past the trail, whose row {b.event_id} tells otherwise",
        BreakKind.ROW_REMOVED: f"{where} is gone, and the trail tells of no deletion: its row {b.event_id} is the last that tells of it",
        BreakKind.ROW_ADDED: f"{where} was put in past the trail, which does not tell of it",
    }[b.kind]


# Accepted false times of the trail: `betaloop audit accept` writes a row of the trail, and `verify` separates them from breaks.
#
# A clock that went fast leaves rows with future times. The first row after it was set right is named for ever, since nothing in the trail
# is changed. What was accepted stays listed, with who, when and why; no other kind of break can be accepted.

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
