"""Sweeps for people and programs: their list, and one sweep's comparison."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from sqlalchemy.orm import Session

from app.learning import repository, sweeps, sweeps_charts
from app.learning.deps import CurrentSweep, SweepViewed
from app.learning.schemas import ALGORITHM_NAMES, BaselineScoreOut, SweepCandidateOut, SweepOut
from app.platform.database import Db
from app.platform.web.schemas import Page, PagingQuery, problems
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.learning import Sweep
from app.tables.participants import Participant

# REST routes of sweeps.

api = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


def _baseline(row: dict[str, Any]) -> BaselineScoreOut:
    gain = row.get("gain_over_cdbs") or {}
    return BaselineScoreOut(
        controller=row["controller"],
        score=row["score"],
        mean_amplitude=row["mean_amplitude"],
        gain_over_cdbs=gain.get("value"),
        gain_low=gain.get("low"),
    )


def sweep_out(db: Session, sweep: Sweep) -> SweepOut:
    """Convert a sweep for the API."""
    return SweepOut(
        id=sweep.id,
        participant=db.get_one(Participant, sweep.participant_id).code,
        name=sweep.name,
        snapshot_id=sweep.snapshot_id,
        job_id=sweep.job_id,
        config=sweep.config,
        held_out_sessions=sweep.baselines["held_out_sessions"],
        candidates=[
            SweepCandidateOut(
                policy_id=c.policy.id,
                name=c.policy.name,
                algorithm=c.policy.algorithm,
                actor_lr=c.rate,
                seed=c.seed,
                best_update=c.best_update,
                score=c.score,
                over_logged=c.over_logged,
                action_distance=c.action_distance,
                saturated=c.saturated,
                mean_amplitude=c.mean_amplitude,
                gain_over_cdbs=c.gain.value if c.gain else None,
                gain_low=c.gain.low if c.gain else None,
                gain_method=None if c.gain is None else "posterior" if c.by_posterior else "fqe",
                supported=c.supported if c.by_posterior else None,
                beyond_margin=c.beyond,
                within_margins=c.within,
                energy_saved=c.saves,
                below_bound=c.below[1] if c.below else None,
            )
            for c in sweeps.candidates(sweep)
        ],
        baselines=[_baseline(row) for row in sweep.baselines["rows"]],
        code_version=sweep.code_version,
        created_at=sweep.created_at,
        created_by=sweep.created_by,
    )


@api.get("/participants/{code}/sweeps", dependencies=[ResultsViewed])
def list_sweeps(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[SweepOut]:
    """List sweeps of a participant, newest first."""
    rows, total = repository.sweeps(db, participant.id, paging.limit, paging.offset)
    return Page(items=[sweep_out(db, s) for s in rows], total=total, limit=paging.limit, offset=paging.offset)


@api.get("/sweeps/{sweep_id}", dependencies=[SweepViewed])
def read_sweep(sweep: CurrentSweep, db: Db) -> SweepOut:
    """Return one sweep: its policies on sessions they did not learn from, and the scores of controllers without learning."""
    return sweep_out(db, sweep)


pages = APIRouter()


@pages.get("/sweeps/{sweep_id}", dependencies=[SweepViewed])
def sweep_page(request: Request, sweep: CurrentSweep, db: Db) -> HTMLResponse:
    """Show one sweep: its policies on held-out sessions, compared with controllers without learning."""
    found = sweeps.candidates(sweep)
    page = render(
        request,
        "learning/sweep.html",
        participant=db.get_one(Participant, sweep.participant_id),
        sweep=sweep,
        candidates=found,
        better=sweeps.better_without_learning(found, sweep.baselines["rows"]),
        surest=sweeps.surely_above_cdbs(found),
        gains=any(c.gain and c.by_posterior for c in found),
        untold=any(c.by_posterior and not c.told for c in found),
        by_posterior=sweeps.ordered_by_posterior(found),
        by_saving=sweeps.ordered_by_saving(found),
        low_ones=[c for c in found if c.leaves_the_logged_range],
        baselines=sorted(sweep.baselines["rows"], key=lambda row: -row["score"]),
        held_out=sweep.baselines["held_out_sessions"],
        charts=sweeps.charts(sweep),
        parallel=sweeps_charts.parallel(found),
        standings=sweeps_charts.STANDINGS,
        looks=sweeps_charts.LOOKS,
        algorithm_names=ALGORITHM_NAMES,
        held_near=sweeps.held_near,
    )
    return HTMLResponse(page)
