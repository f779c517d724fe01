"""REST routes of sweeps."""

from __future__ import annotations

from fastapi import APIRouter
from sqlalchemy.orm import Session

from app.learning import repository
from app.learning.models import Sweep
from app.learning.schemas import SweepCandidateOut, SweepOut, YardstickOut
from app.learning.sweeps import comparison
from app.learning.sweeps.pages import CurrentSweep
from app.platform.database import Db
from app.platform.web.schemas import Page, PagingQuery, problems
from app.study.api import CurrentParticipant
from app.study.models import Participant

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/sweeps")
def list_sweeps(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[SweepOut]:
    """Sweeps of a participant, newest first."""
    rows, total = repository.sweeps(db, participant.id, paging.limit, paging.offset)
    return Page(items=[sweep_out(db, s) for s in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.get("/sweeps/{sweep_id}")
def read_sweep(sweep: CurrentSweep, db: Db) -> SweepOut:
    """One sweep: its policies on sessions they did not learn from, and the scores of controllers without learning."""
    return sweep_out(db, sweep)


def sweep_out(db: Session, sweep: Sweep) -> SweepOut:
    """A sweep for the API."""
    return SweepOut(
        id=sweep.id,
        participant=db.get_one(Participant, sweep.participant_id).code,
        name=sweep.name,
        snapshot_id=sweep.snapshot_id,
        job_id=sweep.job_id,
        config=sweep.config,
        held_out_sessions=sweep.yardsticks["held_out_sessions"],
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
                below_bound=c.below[1] if c.below else None,
            )
            for c in comparison.candidates(sweep)
        ],
        yardsticks=[YardstickOut(**row) for row in sweep.yardsticks["rows"]],
        code_version=sweep.code_version,
        created_at=sweep.created_at,
        created_by=sweep.created_by,
    )
