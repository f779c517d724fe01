"""HTML page that compares policies on a recorded session."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.evaluation.replay import wording
from app.evaluation.replay.figure import LOOKS, figure, frame
from app.evaluation.replay.preselected import TWO, best_first
from app.evaluation.replay.service import MOST, fitting, newest_fitting, recorded, replay_over, sessions_to_replay
from app.learning import repository as learning
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.schemas import RowId
from app.platform.web.templates import render
from app.study import blinding
from app.study.deps import CurrentParticipant, ResultsViewed

router = APIRouter()


@router.get("/participants/{code}/compare", dependencies=[ResultsViewed])
def compare(
    request: Request,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    session: RowId | None = None,
    policy: Annotated[list[RowId] | None, Query(max_length=20)] = None,
    at: Annotated[int, Query(ge=0, le=10**6)] = 0,
) -> HTMLResponse:
    """Two or three policies over a session: what each would have asked. Where no session is named, the newest whose beta they take; where
    no policies are, the two best of the ranking that take its beta."""
    sessions = sessions_to_replay(db, participant)
    available = list(learning.candidates(db, participant.id))
    best = best_first(db, participant, available, caller) if not policy else []
    wanted = list(dict.fromkeys(policy or [p.id for p in best[:TWO]]))[:MOST]
    chosen = session if session is not None else (sessions[0].id if sessions else None)
    found, problem, status = None, None, 200
    if chosen is not None and wanted:
        try:
            named = learning.policies_named(db, participant.id, wanted)
            data = None if session else newest_fitting(db, participant, sessions, best or named, caller, every=bool(policy))
            data = data or recorded(db, participant, chosen, caller)
            chosen = data.session.id
            if fit := fitting(db, participant, data, best)[:TWO]:
                wanted = [p.id for p in fit]
            named = learning.policies_named(db, participant.id, wanted)
            available += [p for p in named if p not in available]  # one that was retired may be looked at too
            found = replay_over(db, participant, data, named)
        except BetaloopError as error:
            problem, status = error.problem(request.url.path), error.status
    step = min(at, len(found.t_s) - 1) if found else 0
    page = render(
        request,
        "evaluation/compare.html",
        participant=participant,
        sessions=[(s.id, _label(db, s, caller)) for s in sessions],
        policies=available,
        session=chosen,
        wanted=wanted,
        slots=MOST,
        found=found,
        step=step,
        drawn=figure(found, step) if found else None,
        frame=frame(found) if found else None,
        looks=LOOKS,
        sentences=wording.differences(found) if found else [],
        amplitude=wording.amplitude,
        problem=problem,
    )
    return HTMLResponse(page, status)


def _label(db: Session, session: Any, caller: Caller) -> str:
    arm = blinding.visible_arm(session, caller)
    return f"visit {session.visit.number}, session {session.ordinal}" + (f": {arm.label}" if arm else "")
