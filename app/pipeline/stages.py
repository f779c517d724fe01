"""Common part of the stages of every job: the participant, the snapshot that everything rests on, facts that later steps need."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.learning import snapshots
from app.platform.errors import Invalid
from app.platform.jobs import JobContext
from app.study.margins import margins_of
from app.tables.learning import BufferSnapshot, Policy
from app.tables.participants import Participant

STORE_WEIGHT = 0.1
"""Share of a job's progress of a step that stores or reads."""

PLAN = "plan"
"""Key of the first step of every kind, which takes the snapshot."""

ComputeStep = tuple[str, str, dict[str, Any]]
"""One call of a compute function: the step's key, the function's name, its params."""


def acting(job: JobContext) -> Caller:
    """Return the caller who submitted the job; what it may do was checked then."""
    return Caller(label=job.created_by, user_id=None, grants=(), is_system=True)


def participant_of(db: Session, job: JobContext) -> Participant:
    """Find the job's participant."""
    if job.participant_id is None:
        raise Invalid(f"A job of kind '{job.kind}' needs a participant.", "Start it from the participant's page.")
    return db.get_one(Participant, job.participant_id)


def take_snapshot(job: JobContext, db: Session) -> BufferSnapshot:
    """Take the snapshot that everything in this job rests on."""
    return snapshots.take_snapshot(db, participant_of(db, job), acting(job))


def snapshot_facts(db: Session, snapshot: BufferSnapshot) -> dict[str, Any]:
    """Collect what later steps need to know of a snapshot, and the margins and levels for assessing its participant's policies."""
    participant = db.get_one(Participant, snapshot.participant_id)
    levels = participant.current_margins
    margins = asdict(margins_of(participant.margins_in_force)) | {"test_within": levels.test_within, "unsafe_beyond": levels.unsafe_beyond}
    known = {"id": snapshot.id, "sha256": snapshot.file_sha256, "sessions": snapshot.sessions, "steps": snapshot.steps}
    return known | {"margins": margins}


def plan_on_snapshot(job: JobContext, more: Callable[[Session, BufferSnapshot], dict[str, Any]] | None = None) -> dict[str, Any]:
    """Run the first step of every kind: take the snapshot and, in the same transaction, read what decides on the steps that follow.

    Returns:
        `snapshot`, its facts, and what `more` gives.
    """

    def plan(db: Session) -> dict[str, Any]:
        snapshot = take_snapshot(job, db)
        return {"snapshot": snapshot_facts(db, snapshot)} | (more(db, snapshot) if more else {})

    return job.transact(PLAN, plan)


def policy_facts(policies: Sequence[Policy]) -> list[dict[str, Any]]:
    """List ids, names and files of policies."""
    return [{"id": p.id, "name": p.name, "sha256": p.onnx_sha256} for p in policies]
