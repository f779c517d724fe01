"""Readable part of the audit trail, for a reader who does not read all of it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from sqlalchemy import ColumnElement
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.overview import trail_rows
from app.overview.trail_changes import SAID
from app.overview.trail_rows import Names
from app.overview.trail_scope import TrailFilter
from app.platform.audit import record
from app.platform.errors import Forbidden, NotFound
from app.platform.web.csv_files import in_pieces
from app.study import blinding
from app.study import repository as study
from app.tables.audit import AuditEvent
from app.tables.plans import Plan

# The audit trail in words: what each row means to a reader ("approved plan 1 of P1"), and which of several names the act.

SEALED_ACT = "took the bundle of a session of a blinded plan"
_ORDER = list(SAID)
_POLICY = re.compile(r"policies/([0-9]+)(?:/(.*))?")


def sentence(event: AuditEvent, names: Names, sealed: bool = False) -> str:
    """Describe a row of the trail, without its subject: the actor is shown next to it.

    Args:
        sealed: whether it is of a blinded plan whose key is sealed: the sentence names no policy then.
    """
    if sealed and event.entity == "bundle_release":
        return SEALED_ACT
    before, after = event.before or {}, event.after or {}
    if event.action not in ("insert", "update", "delete"):
        return _recorded(event, names)
    said = SAID.get(event.entity)
    return said(before, after, names) if said else _plainly(event)


def headline(events: Sequence[AuditEvent]) -> AuditEvent:
    """Choose the change of one request that names the act: rows that merely hang on others do not."""
    return min(events, key=lambda e: (_ORDER.index(e.entity) if e.entity in _ORDER else len(_ORDER), e.id))


def _recorded(event: AuditEvent, names: Names) -> str:
    """Describe an event that changed no row: looks, exports, refusals, false times that were looked into."""
    number = int(event.entity_id) if event.entity_id.isdecimal() else 0
    said: Mapping[tuple[str, str], Callable[[], str]] = {
        ("view", "results"): lambda: f"looked at the results of {_which(event.entity_id, names)}",
        ("view", "visit"): lambda: f"looked at the sessions and results of {names.visit(number)}",
        ("view", "session"): lambda: f"looked at the results of {names.session(number)}",
        ("view", "sweep"): lambda: f"looked at {names.sweep(number)}",
        ("export", "results"): lambda: f"exported the results of {_which(event.entity_id, names)}{_form(event)}",
        ("export", "participant"): lambda: f"exported the record of {names.participant(number)}",
        ("export", "session"): lambda: f"exported the samples of {names.session(number)}",
        ("export", "upload_file"): lambda: f"took the original of file {number}",
        ("export", "audit"): lambda: "exported the audit trail" + _filtered(event),
        ("download", "plan"): lambda: f"printed {names.plan(number)}",
        ("download", "policy"): lambda: f"printed a check of a copy of {names.policy(number)}",
        ("refuse", "sign_in"): lambda: f"refused a sign-in of {event.entity_id}",
        ("refuse", "confirmation"): lambda: f"refused {event.entity_id} a signature or a new password",
        ("accept", "audit_event"): lambda: f"accepted that row {number} of the trail has a false time",
        ("refuse", "sign_on"): lambda: f"refused a sign-on of {event.entity_id}",
    }
    known = said.get((event.action, event.entity))
    return known() if known else f"{event.action}: {event.entity.replace('_', ' ')} {event.entity_id}"


def _which(path: str, names: Names) -> str:
    """Name the results, and whose, by the address of their page."""
    path = path.removeprefix("/api/v1").removesuffix(".csv").removesuffix(".svg")
    if not path.startswith("/participants/"):
        which = path.strip("/").removeprefix("analyses").replace("-", " ").replace("/", " ").strip()
        return "all participants" + (f": {which}" if which else "")
    whose, _, page = path.removeprefix("/participants/").partition("/")
    if of_policy := _POLICY.fullmatch(page):
        return f"{names.policy(int(of_policy[1]))}" + (f": {of_policy[2]}" if of_policy[2] else "")
    return whose + (f": {page.replace('-', ' ').replace('/', ', ')}" if page else "")


def _form(event: AuditEvent) -> str:
    return f" as {str((event.after or {}).get('format', 'csv')).upper()}"


def _filtered(event: AuditEvent) -> str:
    stated = (event.after or {}).get("filters") or {}
    return ": " + ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in stated.items()) if stated else ""


def _plainly(event: AuditEvent) -> str:
    verb = {"insert": "added", "update": "changed", "delete": "removed"}.get(event.action, event.action)
    return f"{verb} a row of {event.entity.replace('_', ' ')}"


# Acts of the audit trail in words, with every row that they changed; nothing of what is hidden from a reader.

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
"""Columns that never reveal what ran; only these are shown of rows that would while the key of a blinded plan is sealed."""


@dataclass(frozen=True)
class Act:
    """Act of one request: in words, by its most telling change, and every row that it changed.

    Attributes:
        event: the change that names it. `said`: in words. reason: why, as far as it may be shown.
        rows: each change with column, value before, value after.
    """

    event: AuditEvent
    said: str
    reason: str | None
    rows: list[tuple[AuditEvent, list[tuple[str, str | None, str | None]]]]


def acts(db: Session, events: Sequence[AuditEvent], caller: Caller) -> list[Act]:
    """Group the events of a page by request; newest first."""
    names = trail_rows.audit_names(db, events)
    sealed = trail_rows.sealed_events(db, events) if not caller.is_system else frozenset()
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
    """List the events one by one, as a table has them. Under a sealed key what ran is hidden from all, the command line too."""
    names, sealed = trail_rows.audit_names(db, events), trail_rows.sealed_events(db, events)
    return [
        Line(e, sentence(e, names, e.id in sealed), None if _hides_reason(e, sealed) else e.reason, changes(db, e, caller, e.id in sealed))
        for e in events
    ]


def _hides_reason(event: AuditEvent, sealed: frozenset[int]) -> bool:
    """Check whether the reason must be hidden: earlier versions wrote a bundle's limits there."""
    return event.id in sealed and event.entity in ("bundle_release", "stored_file")


def changes(db: Session, event: AuditEvent, caller: Caller, sealed: bool) -> list[tuple[str, str | None, str | None]]:
    """List column, value before and value after of an event's changes; arms only through the blinding gate.

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
    """Write a value as text; long ones are cut, the database has them whole."""
    if value is None:
        return None
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 300 else f"{text[:300]} …"


# The audit trail as a table: a line per row of it, in words and with what changed.

COLUMNS = ("number", "time_utc", "who", "what", "reason", "action", "table", "row", "changes", "request")


def as_csv(db: Session, within: ColumnElement[bool], wanted: TrailFilter, caller: Caller) -> Iterator[str]:
    """Yield the rows that match, newest first, a piece at a time, so that a long trail needs no more memory than a short one.

    The export is recorded before the first piece. The caller commits.
    """
    stated = wanted.stated()
    if "words" in stated:
        stated["words"] = "stated"  # typed words may be a name
    record(db, "export", "audit", "trail", {"filters": stated})
    return in_pieces(COLUMNS, _batches(db, within, wanted, caller))


def _batches(db: Session, within: ColumnElement[bool], wanted: TrailFilter, caller: Caller) -> Iterator[list[Sequence[object]]]:
    for events in trail_rows.batches(db, within, wanted):
        yield [_row(line) for line in lines(db, events, caller)]
        db.expunge_all()  # what was written is not kept in memory


def _row(line: Line) -> Sequence[object]:
    e = line.event
    changed = "; ".join(f"{name}: {_side(before)} -> {_side(after)}" for name, before, after in line.changes)
    return (e.id, e.at.isoformat(), e.actor, line.said, line.reason, e.action, e.entity, e.entity_id, changed, e.request_id)


def _side(value: str | None) -> str:
    return "-" if value is None else value
