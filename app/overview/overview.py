"""Study-wide pages: the overview of all participants, and the audit trail."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.repository import studies
from app.overview import state, wording
from app.overview.first_screen import offers
from app.platform.database import Db
from app.platform.web.schemas import PagingQuery
from app.platform.web.templates import render
from app.settings import get_settings
from app.study import repository as study

router = APIRouter()

REFRESH_S = 5
SOON = 12
"""Next visits that stand open; later ones are a fold away."""


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
        demo=get_settings().demo,
        offers=offers(rows, states) if get_settings().demo else [],
        withdrawn=withdrawn == "yes",
        paging=paging,
        phases=state.PHASES,
        refresh_s=REFRESH_S,
        studies=[s for s in studies(db) if caller.may(can.READ, s.id) and (withdrawn == "yes" or s.ended_at is None)],
    )
    return HTMLResponse(page)
