"""The step between two visits of the paper: continue from the policies that did best in their sessions, and train fresh ones as well."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import SYSTEM, Caller
from app.evaluation import repository as evaluation
from app.evaluation.estimates.service import estimate_of
from app.evaluation.ranking.staleness import stale_reasons
from app.learning import repository as learning
from app.learning.policies import window_of
from app.pipeline import service as pipeline
from app.pipeline.params import NEXT_GENERATION, NextGenerationParams
from app.platform.jobs import repository as jobs
from app.study import access
from app.study import repository as study
from app.study.adverse_events import blocked_policies, events_of_participant
from app.study.blinding import arm
from app.tables.evaluations import Evaluation
from app.tables.jobs import Job, JobStatus
from app.tables.learning import Policy
from app.tables.participants import Participant
from ml.ope import POSTERIOR

# Parents of a generation: the policies that ran in sessions, the best by the posterior first.

TRAINABLE = ("trained", "distilled")


@dataclass(frozen=True)
class Tested:
    """A policy that ran, with the number of its sessions that count and the last visit that tested it.

    Attributes:
        obstacle: what keeps it from being trained further, as a sentence; empty where it may be.
    """

    policy: Policy
    sessions: int
    last_visit: int
    obstacle: str = ""


def tested_policies(db: Session, participant: Participant) -> list[Tested]:
    """List policies that can be trained further and ran in a confirmed session that is not excluded, oldest first."""
    return [t for t in policies_that_ran(db, participant) if not t.obstacle]


def policies_that_ran(db: Session, participant: Participant) -> list[Tested]:
    """List policies that ran in a confirmed session that is not excluded, each with what keeps it from being trained further.

    These are retirement, another window than the current settings, and a serious event or stop that no clinician has cleared.
    """
    visits: dict[int, list[int]] = {}
    for session in study.sessions_of_participant(db, participant.id):
        if session.visit.sealed:
            continue  # what continues from it would reveal what ran
        # which policies did best does not depend on who asks; only those who may know every arm can
        policy_id = arm(session, SYSTEM).policy_id
        if policy_id is not None and session.excluded_reason is None:
            visits.setdefault(policy_id, []).append(session.visit.number)
    harmful = blocked_policies(events_of_participant(db, participant.id), SYSTEM)
    window = participant.current_settings.window
    ran = learning.policies_named(db, participant.id, sorted(visits))
    return [Tested(p, len(visits[p.id]), max(visits[p.id]), _obstacle(p, p.id in harmful, window)) for p in ran]


def _obstacle(policy: Policy, harmful: bool, window: int) -> str:
    """Say what keeps a policy from being trained further, with the way on; empty where nothing does."""
    if policy.kind not in TRAINABLE:
        return "It was made elsewhere, and cannot be trained further here."
    if policy.retired_reason:
        return f"It was retired ({policy.retired_reason}). Take it back on its page."
    if harmful:
        return "A serious event or stop under it is not cleared. A clinician clears it on the page of adverse events."
    if (own := window_of(policy)) != window:
        return f"It takes windows of {own} beta amplitudes, the settings say {window}. Set the window back, or train new policies."
    return ""


def posterior_of(found: Evaluation | None) -> dict[int, float]:
    """Return the posterior's estimated returns by policy; empty where the evaluation has none."""
    return {} if found is None else {row.policy_id: estimate_of(row).value for row in found.estimates if row.method == POSTERIOR}


def posterior_on(db: Session, participant_id: int, snapshot_id: int) -> dict[int, float]:
    """Return the posterior's returns by policy where the newest evaluation rests on this snapshot, so that it knows all sessions; else
    empty."""
    newest = evaluation.newest_evaluation(db, participant_id)
    return posterior_of(newest) if newest is not None and newest.snapshot_id == snapshot_id else {}


def best(tested: Sequence[Policy], posterior: Mapping[int, float], most: int) -> list[Policy]:
    """Choose the policies to continue from: the highest posterior return first, one of a teacher and its student, at most `most`."""
    chosen: list[Policy] = []
    families: set[int] = set()
    for policy in sorted((p for p in tested if p.id in posterior), key=lambda p: (-posterior[p.id], p.id)):
        family = policy.teacher_id or policy.id
        if family not in families and len(chosen) < most:
            chosen.append(policy)
            families.add(family)
    return chosen


# Rules of the next generation: what it would go on from, and that it is trained once from the same data. The caller commits.


@dataclass(frozen=True)
class Outlook:
    """Outlook on a participant's next generation.

    Attributes:
        tested: what it may go on from, the best by the newest ranking first. posterior: its estimated returns by policy.
        blocked: policies that ran and cannot be trained further.
        ranking: the newest one; None without any. current: whether it knows everything that was recorded.
        live: the job at work. done: the job that trained the generation of the data as they are now; None where something came since.
    """

    tested: list[Tested]
    posterior: dict[int, float]
    ranking: Evaluation | None
    current: bool
    live: Job | None
    done: Job | None
    blocked: list[Tested]

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
    ran = policies_that_ran(db, participant)
    tested = sorted((t for t in ran if not t.obstacle), key=lambda t: (-posterior.get(t.policy.id, -math.inf), t.policy.id))
    return Outlook(tested, posterior, newest, current, rows[0] if rows else None, done, [t for t in ran if t.obstacle])


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
