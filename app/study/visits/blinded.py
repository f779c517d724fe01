"""A visit as a blinded assessor sees it: its sessions with their QoCs, and nothing that gives the controllers away."""

from __future__ import annotations

from collections.abc import Mapping

from fastapi import Request
from fastapi.responses import HTMLResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.errors import BetaloopError
from app.platform.web.forms import field_notes
from app.platform.web.templates import render
from app.study import repository
from app.study.access import may
from app.tables.sessions import StudySession
from app.tables.visits import Visit


def blinded_page(
    request: Request,
    db: Session,
    visit: Visit,
    caller: Caller,
    error: BetaloopError | None = None,
    refused: StudySession | None = None,
    typed: Mapping[str, str] | None = None,
) -> HTMLResponse:
    """The page; `refused` is the session whose form was, and `typed` what it said."""
    sessions, _ = repository.sessions_of_visit(db, visit.id)
    page = render(
        request,
        "study/visits/visit_blinded.html",
        visit=visit,
        participant=visit.participant,
        sessions=sessions,
        may_rate=may(caller, can.WRITE_QOC, visit.participant),
        refused=refused.id if refused else None,
        typed=typed or {},
        remarks=field_notes(error, typed or {}),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
