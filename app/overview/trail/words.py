"""The audit trail in words: what each row means to a reader ("approved plan 1 of P1"), and which of several names the act."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from app.overview.trail.changes import SAID
from app.overview.trail.names import Names
from app.tables.audit import AuditEvent

SEALED_ACT = "took the bundle of a session of a blinded plan"
_ORDER = list(SAID)
_POLICY = re.compile(r"policies/([0-9]+)(?:/(.*))?")


def sentence(event: AuditEvent, names: Names, sealed: bool = False) -> str:
    """What a row of the trail means, without its subject: the actor stands beside it.

    Args:
        sealed: whether it is of a blinded plan whose key is sealed: the sentence tells no policy then.
    """
    if sealed and event.entity == "bundle_release":
        return SEALED_ACT
    before, after = event.before or {}, event.after or {}
    if event.action not in ("insert", "update", "delete"):
        return _recorded(event, names)
    said = SAID.get(event.entity)
    return said(before, after, names) if said else _plainly(event)


def headline(events: Sequence[AuditEvent]) -> AuditEvent:
    """Of the changes of one request, the one that names the act: rows that merely hang on others do not."""
    return min(events, key=lambda e: (_ORDER.index(e.entity) if e.entity in _ORDER else len(_ORDER), e.id))


def _recorded(event: AuditEvent, names: Names) -> str:
    """What changed no row: looks, exports, refusals, false times that were looked into."""
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
        ("refuse", "sign_in"): lambda: f"refused a sign-in of {event.entity_id}",
        ("refuse", "confirmation"): lambda: f"refused {event.entity_id} a signature or a new password",
        ("accept", "audit_event"): lambda: f"accepted that row {number} of the trail has a false time",
        ("refuse", "sign_on"): lambda: f"refused a sign-on of {event.entity_id}",
    }
    known = said.get((event.action, event.entity))
    return known() if known else f"{event.action}: {event.entity.replace('_', ' ')} {event.entity_id}"


def _which(path: str, names: Names) -> str:
    """Whose results, and which, by the address of their page."""
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
