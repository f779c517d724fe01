"""Rules of the next generation: what it would go on from, and that it is trained once from the same data. The caller commits."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation import repository as evaluation
from app.evaluation.ranking.staleness import stale_reasons
from app.learning import repository as learning
from app.pipeline import service as pipeline
from app.pipeline.next_generation.parents import Tested, best, posterior_of, tested_policies
from app.pipeline.params import NEXT_GENERATION, NextGenerationParams
from app.platform.jobs import repository as jobs
from app.study import access
from app.tables.evaluations import Evaluation
from app.tables.jobs import Job, JobStatus
from app.tables.participants import Participant


@dataclass(frozen=True)
class Outlook:
    """Outlook on a participant's next generation.

    Attributes:
        tested: what it may go on from, the best by the newest ranking first. posterior: its estimated returns by policy.
        ranking: the newest one; None without any. current: whether it knows everything that was recorded.
        live: the job at work. done: the job that trained the generation of the data as they are now; None where something came since.
    """

    tested: list[Tested]
    posterior: dict[int, float]
    ranking: Evaluation | None
    current: bool
    live: Job | None
    done: Job | None

    def parents(self, most: int) -> list[int]:
        """List the policies that it continues from, the best first; empty where the job assesses the tested ones with the new sessions
        first."""
        return [p.id for p in best([t.policy for t in self.tested], self.posterior, most)] if self.current else []


def outlook(db: Session, participant: Participant, caller: Caller) -> Outlook:
    """Collect what the page shows before a generation is started. Raises Forbidden for callers who may not run jobs."""
    access.require(caller, can.RUN_JOBS, participant)
    newest = evaluation.newest_evaluation(db, participant.id)
    current = newest is not None and not stale_reasons(db, participant, newest)
    rows, _ = jobs.find(db, participant.id, NEXT_GENERATION, jobs.LIVE, limit=1)
    done = _made_on(db, participant.id, newest.snapshot_id) if newest is not None and current else None
    posterior = posterior_of(newest)
    tested = sorted(tested_policies(db, participant), key=lambda t: (-posterior.get(t.policy.id, -math.inf), t.policy.id))
    return Outlook(tested, posterior, newest, current, rows[0] if rows else None, done)


def _made_on(db: Session, participant_id: int, snapshot_id: int) -> Job | None:
    """Find the job that trained a generation on a snapshot, also if it was evaluated again since; None where none did."""
    ended, _ = jobs.find(db, participant_id, NEXT_GENERATION, (JobStatus.SUCCEEDED,), limit=1)
    made = evaluation.evaluation_of_job(db, ended[0].id) if ended else None
    return ended[0] if made is not None and made.snapshot_id == snapshot_id else None


def start(db: Session, participant: Participant, params: NextGenerationParams, caller: Caller) -> Job:
    """Train the next generation; the job that does, or that has done so from the same data, is given instead of a second one.

    Raises:
        Forbidden: the caller may not run jobs. Invalid: no policy that could be trained further was tested, or no usable session.
    """
    access.require(caller, can.RUN_JOBS, participant)
    # two clicks at once: the second waits here and finds the job of the first
    learning.lock_participant(db, participant.id)
    found = outlook(db, participant, caller)
    return found.live or found.done or pipeline.start_job(db, participant, NEXT_GENERATION, params.model_dump(mode="json"), caller).job
