"""FastAPI dependencies: the policy, snapshot or sweep that a path names, within what the caller may read; and who looked at a sweep."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from fastapi import Depends

from app.accounts.deps import CurrentCaller
from app.learning import repository
from app.platform.audit import record_view
from app.platform.database import Db
from app.platform.web.schemas import RowId
from app.study import access
from app.study.deps import CurrentParticipant
from app.tables.learning import BufferSnapshot, Policy, Sweep


def current_policy(policy_id: RowId, db: Db, caller: CurrentCaller) -> Policy:
    """Find the policy that the path names."""
    return repository.policy(db, policy_id, caller)


def current_snapshot(snapshot_id: RowId, db: Db, caller: CurrentCaller) -> BufferSnapshot:
    """Find the snapshot that the path names."""
    return repository.snapshot(db, snapshot_id, caller)


def current_own_policy(participant: CurrentParticipant, policy_id: RowId, db: Db, caller: CurrentCaller) -> Policy:
    """Find the policy that the path names after its participant. Raises NotFound for another participant's."""
    policy = repository.policy(db, policy_id, caller)
    access.require_own(participant, policy, f"policy {policy_id}")
    return policy


CurrentPolicy = Annotated[Policy, Depends(current_policy)]
CurrentOwnPolicy = Annotated[Policy, Depends(current_own_policy)]


CurrentSnapshot = Annotated[BufferSnapshot, Depends(current_snapshot)]


def current_sweep(sweep_id: RowId, db: Db, caller: CurrentCaller) -> Sweep:
    """Find the sweep that the path names."""
    return repository.sweep(db, sweep_id, caller)


CurrentSweep = Annotated[Sweep, Depends(current_sweep)]


def sweep_viewed(sweep: CurrentSweep, db: Db) -> Iterator[None]:
    """Record who looked, for routes that show what policies of a sweep are predicted to bring, as `app.study.deps` does."""
    yield
    record_view(db, "sweep", sweep.id)


SweepViewed = Depends(sweep_viewed, scope="function")
