"""Sweeps for people and programs: their list, and one sweep's comparison."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from app.learning.deps import CurrentSweep, SweepViewed
from app.learning.schemas import ALGORITHM_NAMES
from app.learning.sweeps import comparison, parallel
from app.platform.database import Db
from app.platform.web.templates import render
from app.tables.participants import Participant

router = APIRouter()


@router.get("/sweeps/{sweep_id}", dependencies=[SweepViewed])
def sweep_page(request: Request, sweep: CurrentSweep, db: Db) -> HTMLResponse:
    """Show one sweep: its policies on held-out sessions, compared with controllers without learning."""
    found = comparison.candidates(sweep)
    page = render(
        request,
        "learning/sweep.html",
        participant=db.get_one(Participant, sweep.participant_id),
        sweep=sweep,
        candidates=found,
        better=comparison.better_without_learning(found, sweep.baselines["rows"]),
        surest=comparison.surely_above_cdbs(found),
        gains=any(c.gain and c.by_posterior for c in found),
        untold=any(c.by_posterior and not c.told for c in found),
        by_posterior=comparison.ordered_by_posterior(found),
        by_saving=comparison.ordered_by_saving(found),
        low_ones=[c for c in found if c.leaves_the_logged_range],
        baselines=sorted(sweep.baselines["rows"], key=lambda row: -row["score"]),
        held_out=sweep.baselines["held_out_sessions"],
        charts=comparison.charts(sweep),
        parallel=parallel.parallel(found),
        standings=parallel.STANDINGS,
        looks=parallel.LOOKS,
        algorithm_names=ALGORITHM_NAMES,
        held_near=comparison.held_near,
    )
    return HTMLResponse(page)
