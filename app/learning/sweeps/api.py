"""REST routes of sweeps."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from sqlalchemy.orm import Session

from app.learning import repository
from app.learning.deps import CurrentSweep, SweepViewed
from app.learning.schemas import BaselineScoreOut, SweepCandidateOut, SweepOut
from app.learning.sweeps import comparison
from app.platform.database import Db
from app.platform.web.schemas import Page, PagingQuery, problems
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.learning import Sweep
from app.tables.participants import Participant

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


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
            for c in comparison.candidates(sweep)
        ],
        baselines=[_baseline(row) for row in sweep.baselines["rows"]],
        code_version=sweep.code_version,
        created_at=sweep.created_at,
        created_by=sweep.created_by,
    )


@router.get("/participants/{code}/sweeps", dependencies=[ResultsViewed])
def list_sweeps(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[SweepOut]:
    """Sweeps of a participant, newest first."""
    rows, total = repository.sweeps(db, participant.id, paging.limit, paging.offset)
    return Page(items=[sweep_out(db, s) for s in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.get("/sweeps/{sweep_id}", dependencies=[SweepViewed])
def read_sweep(sweep: CurrentSweep, db: Db) -> SweepOut:
    """One sweep: its policies on sessions they did not learn from, and the scores of controllers without learning."""
    return sweep_out(db, sweep)
