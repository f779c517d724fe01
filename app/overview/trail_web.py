"""The page of the audit trail, and the same rows as a table to take away."""

from __future__ import annotations

from urllib.parse import urlencode

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse
from sqlalchemy import ColumnElement, true
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.accounts.service import reads_whole_audit
from app.overview import trail_rows
from app.overview.trail import acts, as_csv
from app.overview.trail_scope import KINDS, SHOWN_NAMES, TrailFilter, of_reader
from app.platform.audit import AUDITED
from app.platform.database import Db
from app.platform.errors import Invalid
from app.platform.web.csv_files import stream
from app.platform.web.forms import parse
from app.platform.web.schemas import PagingQuery
from app.platform.web.templates import render

pages = APIRouter()

LABELS = {
    "words": "Search", "participant": "Participant", "action": "Kind of act", "entity": "What was changed", "entity_id": "Its number",
    "actor": "Who", "begin": "From", "end": "To",
}  # fmt: skip


@pages.get("/audit")
def audit(request: Request, db: Db, caller: CurrentCaller, paging: PagingQuery) -> HTMLResponse:
    """Show who did what, when and why, newest first; of the studies and sites in which the caller reads the trail."""
    caller.require(can.READ_AUDIT)
    typed, problem = _typed(request), None
    try:
        wanted = _wanted(typed)
        events, total = trail_rows.audit_events(db, within(db, caller), wanted, paging.limit, paging.offset)
    except Invalid as error:
        events, total, problem = [], 0, error.problem(request.url.path)
    page = render(
        request,
        "overview/audit.html",
        acts=acts(db, events, caller),
        total=total,
        whole=reads_whole_audit(db, caller),
        paging=paging,
        tables=sorted(((name, SHOWN_NAMES.get(name, name.replace("_", " "))) for name in AUDITED), key=lambda option: option[1]),
        kinds=[(name, kind.said) for name, kind in KINDS.items()],
        labels=LABELS,
        filters=dict.fromkeys(LABELS, "") | typed,
        query=urlencode(typed),
        problem=problem,
    )
    return HTMLResponse(page, 422 if problem else 200)


@pages.get("/audit.csv")
def audit_table(request: Request, db: Db, caller: CurrentCaller) -> Response:
    """Download the rows that the page's filters leave, all of them; the export is one of the trail's rows."""
    caller.require(can.READ_AUDIT)
    pieces = as_csv(db, within(db, caller), _wanted(_typed(request)), caller)
    return stream(pieces, "audit-trail.csv")


def within(db: Session, caller: Caller) -> ColumnElement[bool]:
    """Build the condition on the trail: the rows that the caller reads."""
    return true() if reads_whole_audit(db, caller) else of_reader(caller)


def _typed(request: Request) -> dict[str, str]:
    """Return the filters of an address that are not empty."""
    return {name: value for name in TrailFilter.model_fields if (value := request.query_params.get(name, "").strip())}


def _wanted(typed: dict[str, str]) -> TrailFilter:
    """Parse the filters. Raises Invalid, naming the field."""
    return parse(TrailFilter, typed, LABELS)
