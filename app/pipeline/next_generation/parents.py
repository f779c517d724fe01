"""Parents of a generation: the policies that ran in sessions, the best by the posterior first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation import repository as evaluation
from app.evaluation.estimates.rows import estimate_of
from app.learning import repository as learning
from app.learning.policies.service import window_of
from app.study import repository as study
from app.study.adverse_events import blocked_policies, events_of_participant
from app.study.blinding import arm
from app.tables.evaluations import Evaluation
from app.tables.learning import Policy
from app.tables.participants import Participant
from ml.ope import POSTERIOR

TRAINABLE = ("trained", "distilled")


@dataclass(frozen=True)
class Tested:
    """A policy that may be trained further, with the number of its sessions that count and the last visit that tested it."""

    policy: Policy
    sessions: int
    last_visit: int


def tested_policies(db: Session, participant: Participant) -> list[Tested]:
    """List policies that can be trained further and ran in a confirmed session that is not excluded, oldest first.

    Retired ones are excluded, and those of another window than the current settings. So are those under which a serious adverse event
    happened that no clinician has cleared.
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
    usable = [p for p in learning.candidates(db, participant.id) if p.kind in TRAINABLE and p.id in visits and p.id not in harmful]
    return [Tested(p, len(visits[p.id]), max(visits[p.id])) for p in usable if window_of(p) == window]


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
