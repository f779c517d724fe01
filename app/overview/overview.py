"""Study-wide pages: the overview of all participants, and the audit trail."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import groupby
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse
from sqlalchemy import true
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.accounts.repository import studies
from app.accounts.service import reads_whole_audit
from app.overview import repository, state, wording
from app.overview.audit_words import headline, sentence
from app.overview.trail.repository import of_reader
from app.planning.plans.models import Plan
from app.platform.audit import AUDITED, AuditEvent
from app.platform.database import Db
from app.platform.errors import Forbidden, NotFound
from app.platform.web.schemas import PagingQuery, Text
from app.platform.web.templates import render
from app.study import blinding
from app.study import repository as study

router = APIRouter()

REFRESH_S = 5
SOON = 12
"""Next visits that stand open; later ones are a fold away."""
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


@router.get("/")
def overview(
    request: Request, db: Db, caller: CurrentCaller, paging: PagingQuery, withdrawn: Annotated[str, Query(max_length=3)] = "no"
) -> HTMLResponse:
    """Today: the next visits with what each waits for, then all participants as cards, those that need attention marked."""
    rows, total = study.participants(db, caller, paging.limit, paging.offset, withdrawn=withdrawn == "yes")
    today = datetime.now(UTC).date()
    # of the whole study: whoever is seen tomorrow may stand on another page of participants
    coming = study.next_visits(db, caller, today, withdrawn=withdrawn == "yes")
    states = state.states(db, list(dict.fromkeys([*rows, *coming])), today)
    page = render(
        request,
        "overview/overview.html",
        participants=[(p, states[p.id]) for p in rows],
        coming=[(p, states[p.id]) for p in coming],
        soon=SOON,
        today=today,
        what=wording.what,
        actors=wording.ACTORS,
        progress=wording.progress,
        in_days=wording.in_days,
        total=total,
        withdrawn=withdrawn == "yes",
        paging=paging,
        phases=state.PHASES,
        refresh_s=REFRESH_S,
        studies=[s for s in studies(db) if caller.may(can.READ, s.id) and (withdrawn == "yes" or s.ended_at is None)],
    )
    return HTMLResponse(page)


@router.get("/audit")
def audit(
    request: Request,
    db: Db,
    caller: CurrentCaller,
    paging: PagingQuery,
    entity: Annotated[Text, Query(max_length=63)] = "",
    entity_id: Annotated[Text, Query(max_length=200)] = "",
    actor: Annotated[Text, Query(max_length=254)] = "",
) -> HTMLResponse:
    """Who changed what, when and why, newest first; of the studies and sites in which the caller reads it."""
    caller.require(can.READ_AUDIT)
    whole = reads_whole_audit(db, caller)
    within = true() if whole else of_reader(caller)
    events, total = repository.audit_events(db, within, entity, entity_id, actor.strip().lower(), paging.limit, paging.offset)
    page = render(
        request,
        "overview/audit.html",
        acts=acts(db, events, caller),
        total=total,
        whole=whole,
        paging=paging,
        entities=sorted(AUDITED),
        filters={"entity": entity, "entity_id": entity_id, "actor": actor},
    )
    return HTMLResponse(page)


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
        said = wording.SEALED_ACT if telling.id in sealed and telling.entity == "bundle_release" else sentence(telling, names)
        # earlier versions wrote a bundle's limits there
        of_bundle = any(e.id in sealed and e.entity in ("bundle_release", "stored_file") for e in rows)
        found.append(Act(telling, said, None if of_bundle else telling.reason, [(e, changes(db, e, caller, e.id in sealed)) for e in rows]))
    return found


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
