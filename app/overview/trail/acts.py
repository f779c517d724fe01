"""What the audit trail shows of its rows: acts in words with every row that they changed, and nothing of what is hidden from a reader."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.overview.trail import repository
from app.overview.trail.words import headline, sentence
from app.platform.errors import Forbidden, NotFound
from app.study import blinding
from app.study import repository as study
from app.tables.audit import AuditEvent
from app.tables.plans import Plan

_ARM_COLUMNS = ("controller", "policy_id")
_HIDDEN = "hidden from you"
_KEPT = {
    "session": frozenset(
        {"id", "visit_id", "ordinal", "status", "plan_item_id", "hemisphere", "started_at", "duration_s", "excluded_reason"}
    ),
    "plan_item": frozenset(
        {"id", "plan_id", "position", "minutes", "washout_minutes", "break_minutes", "label", "medication", "hemisphere"}
    ),
    "session_proposal": frozenset({"session_id", "upload_id", "visit_open", "changed_by", "version"}),
    "session_conditions": frozenset({"id", "session_id", "revision", "entered_by", "reason", "created_at"}),
    "bundle_release": frozenset({"id", "participant_id", "plan_item_id", "created_at", "created_by"}),
    "adverse_event": frozenset({"id", "participant_id", "visit_id", "session_id", "entry_key", "created_at"}),
    "stored_file": frozenset({"sha256", "size", "created_at"}),
    "plan": frozenset(c.name for c in Plan.__table__.columns) - {"seed", "rules"},  # from which the order is drawn
}
"""Columns that tell nobody what ran, of tables that would: all that is shown of their rows while the key of a blinded plan is sealed."""


@dataclass(frozen=True)
class Act:
    """What one request did: in words, by its most telling change, and every row that it changed.

    Attributes:
        event: the change that names it. said: in words. reason: why, as far as it may be shown.
        rows: each change with column, value before, value after.
    """

    event: AuditEvent
    said: str
    reason: str | None
    rows: list[tuple[AuditEvent, list[tuple[str, str | None, str | None]]]]


def acts(db: Session, events: Sequence[AuditEvent], caller: Caller) -> list[Act]:
    """The events of a page, those of one request together; newest first."""
    names = repository.audit_names(db, events)
    sealed = repository.sealed_events(db, events) if not caller.is_system else frozenset()
    found = []
    for _, group in groupby(events, key=lambda e: (e.actor, e.request_id or e.id)):
        rows = list(group)
        telling = headline(rows)
        said = sentence(telling, names, telling.id in sealed)
        told = [(e, changes(db, e, caller, e.id in sealed)) for e in rows]
        found.append(Act(telling, said, None if any(_hides_reason(e, sealed) for e in rows) else telling.reason, told))
    return found


@dataclass(frozen=True)
class Line:
    """One row of the trail for programs: as `Act`, of one row alone."""

    event: AuditEvent
    said: str
    reason: str | None
    changes: list[tuple[str, str | None, str | None]]


def lines(db: Session, events: Sequence[AuditEvent], caller: Caller) -> list[Line]:
    """The events as a table has them, one after another. Under a sealed key nobody is told what ran, the command line neither."""
    names, sealed = repository.audit_names(db, events), repository.sealed_events(db, events)
    return [
        Line(e, sentence(e, names, e.id in sealed), None if _hides_reason(e, sealed) else e.reason, changes(db, e, caller, e.id in sealed))
        for e in events
    ]


def _hides_reason(event: AuditEvent, sealed: frozenset[int]) -> bool:
    """Earlier versions wrote a bundle's limits there."""
    return event.id in sealed and event.entity in ("bundle_release", "stored_file")


def changes(db: Session, event: AuditEvent, caller: Caller, sealed: bool) -> list[tuple[str, str | None, str | None]]:
    """Column, value before, value after of what an event changed; arms only through the blinding gate.

    Args:
        sealed: whether the row is one of a blinded plan whose key is sealed, or of its sessions.
    """
    before, after = event.before or {}, event.after or {}
    names = [n for n in dict.fromkeys([*before, *after]) if before.get(n) != after.get(n)]
    hidden: Collection[str] = ()
    if sealed:
        hidden = set(names) - _KEPT[event.entity]
    elif event.entity == "session" and not _may_know_arm(db, event.entity_id, caller):
        hidden = _ARM_COLUMNS
    return [
        (name, _HIDDEN if name in hidden else _short(before.get(name)), _HIDDEN if name in hidden else _short(after.get(name)))
        for name in names
    ]


def _may_know_arm(db: Session, session_id: str, caller: Caller) -> bool:
    try:
        return blinding.may_know(study.session(db, int(session_id), caller).visit, caller)
    except (NotFound, Forbidden):
        return False


def _short(value: Any) -> str | None:
    """A value as text; long ones are cut, the database has them whole."""
    if value is None:
        return None
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 300 else f"{text[:300]} …"
