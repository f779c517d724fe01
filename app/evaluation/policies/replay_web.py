"""HTML page that compares policies on a recorded session."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse
from markupsafe import Markup
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.evaluation.policies import replay as replays
from app.evaluation.policies.replay import (
    MOST,
    TWO,
    ReplayOut,
    best_first,
    fitting,
    newest_fitting,
    recorded,
    replay,
    replay_over,
    sessions_to_replay,
)
from app.learning import repository as learning
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.charts import written
from app.platform.web.schemas import RowId, problems
from app.platform.web.svg import Plane, apart, drawing
from app.platform.web.templates import render
from app.study import blinding
from app.study.deps import CurrentParticipant, ResultsViewed

# The comparison as a figure without a script, and the numbers that a script needs to move along it.

LOOKS = (("rl", ""), ("accent", "7 3"), ("distilled", "2 3"))
"""Colour and dashes of the policies, in their order."""

W, LEFT, RIGHT = 1100.0, 60.0, 132.0
NAME_LETTERS = 16
"""Letters of a policy's name that fit next to its line; the table below has all of it."""
BETA_H, AMPLITUDE_H, TOP, BETWEEN, BOTTOM = 120.0, 220.0, 30.0, 62.0, 44.0


def figure(found: ReplayOut, step: int) -> Markup:
    """Draw beta above, amplitudes below: recorded in grey, a line for each policy with its name, and the cursor.

    Args:
        found: the comparison. step: of the cursor.
    """
    unit_ma = found.cdbs_amplitude_ma
    factor, unit = (unit_ma, "mA") if unit_ma is not None else (100.0, "% of cDBS")
    minutes = [t / 60 for t in found.t_s]
    span = (0.0, minutes[-1] + found.period_s / 60)
    beta = [v for v in found.beta if v is not None]
    above = Plane(LEFT, TOP, W - LEFT - RIGHT, BETA_H, span, (min(0.0, *beta), 1.05 * max(beta)) if beta else (0.0, 1.0))
    above.axes("", f"Beta ({written(found.beta_unit)})", y_ticks=3)
    above.line(list(zip(minutes, found.beta, strict=True)), "muted", 1.2)
    top = TOP + BETA_H + BETWEEN
    known = [v for v in found.recorded_fraction if v is not None]
    below = Plane(LEFT, top, W - LEFT - RIGHT, AMPLITUDE_H, span, (0.0, factor * max(1.08, *known, 0.0)))
    below.axes("Time in the session (min)", f"Amplitude ({unit})", x_ticks=10)
    below.level(factor, "cDBS", "cdbs")
    held = [(t, None if v is None else v * factor) for t, v in zip(minutes, found.recorded_fraction, strict=True)]
    below.line(held, "border", 3.5, step=True)
    named = [("stimulated", "muted", held)]
    for (colour, dash), asked in zip(LOOKS, found.asked, strict=False):
        values = [(t, None if v is None else v * factor) for t, v in zip(minutes, asked.fraction, strict=True)]
        below.line(values, colour, 2.0, dash, step=True)
        named.append((asked.name[:NAME_LETTERS], colour, values))
    _names(below, named)
    at = below.at_x(minutes[step])
    for plane in (above, below):
        ends = f'y1="{plane.top:.0f}" y2="{plane.top + plane.height:.0f}"'
        plane.parts.append(f'<line data-cursor x1="{at:.1f}" x2="{at:.1f}" {ends} stroke="var(--c-text)" stroke-width="1"/>')
    names = ", ".join(a.name for a in found.asked)
    told = f"Lines: {names}. Grey: what stimulated in fact. Would have asked, not would have happened."
    return drawing(W, top + AMPLITUDE_H + BOTTOM, "What the policies would have asked for", told, [above, below])


def _names(plane: Plane, lines: Sequence[tuple[str, str, Sequence[tuple[float, float | None]]]]) -> None:
    """Place the name of each line in its colour, next to its last value; a line without any has none."""
    ends = [(name, colour, next((v for _, v in reversed(values) if v is not None), None)) for name, colour, values in lines]
    known = [(name, colour, plane.at_y(value) + 4) for name, colour, value in ends if value is not None]
    places = apart([y for _, _, y in known], low=plane.top + 4, high=plane.top + plane.height)
    for (name, colour, _), y in zip(known, places, strict=True):
        plane.text(plane.left + plane.width + 8, y, name, "start", colour, weight=650)


def frame(found: ReplayOut) -> dict[str, Any]:
    """Return the data for moving along the session: where the figure begins and ends, and the numbers of every step."""
    return {
        "left": LEFT,
        "width": W - LEFT - RIGHT,
        "t_s": found.t_s,
        "period_s": found.period_s,
        "cdbs_ma": found.cdbs_amplitude_ma,
        "rows": [_short(found.beta), _short(found.recorded_fraction), *(_short(a.fraction) for a in found.asked)],
    }


def _short(values: list[float | None]) -> list[float | None]:
    return [None if v is None else round(v, 3) for v in values]


# REST route of the comparison of policies on a recorded session.

api = APIRouter(tags=["evaluation"], responses=problems(401, 403, 404, 422))


@api.get("/participants/{code}/replay", dependencies=[ResultsViewed])
def read_replay(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    session: Annotated[RowId, Query(description="A recorded session of the participant.")],
    policy: Annotated[list[RowId], Query(min_length=1, max_length=MOST, description="Policies to compare.")],
) -> ReplayOut:
    """Return what policies would have requested on a recorded session's beta: not what would have happened."""
    return replay(db, participant, session, learning.policies_named(db, participant.id, list(dict.fromkeys(policy))), caller)


pages = APIRouter()


@pages.get("/participants/{code}/compare", dependencies=[ResultsViewed])
def compare(
    request: Request,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    session: RowId | None = None,
    policy: Annotated[list[RowId] | None, Query(max_length=20)] = None,
    at: Annotated[int, Query(ge=0, le=10**6)] = 0,
) -> HTMLResponse:
    """Compare two or three policies over a session. By default it is the newest session whose beta they take, and the two best of the
    ranking that take its beta.
    """
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
        no_policy="" if available else learning.no_candidate(db, participant.id),
        session=chosen,
        wanted=wanted,
        slots=MOST,
        found=found,
        step=step,
        drawn=figure(found, step) if found else None,
        frame=frame(found) if found else None,
        looks=LOOKS,
        sentences=replays.differences(found) if found else [],
        amplitude=replays.amplitude,
        problem=problem,
    )
    return HTMLResponse(page, status)


def _label(db: Session, session: Any, caller: Caller) -> str:
    arm = blinding.visible_arm(session, caller)
    return f"visit {session.visit.number}, session {session.ordinal}" + (f": {arm.label}" if arm else "")
