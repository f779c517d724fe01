"""Breaks of the trail, of what writes it, and of the rows that it covers; and the sentences about them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

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
