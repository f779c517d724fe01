"""FastAPI dependencies: the policy, snapshot or sweep that a path names, within what the caller may read."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends

from app.accounts.deps import CurrentCaller
from app.learning import repository
from app.learning.models import BufferSnapshot, Policy, Sweep
from app.platform.database import Db
from app.platform.web.schemas import RowId


def current_policy(policy_id: RowId, db: Db, caller: CurrentCaller) -> Policy:
    """The policy that the path names."""
    return repository.policy(db, policy_id, caller)


def current_snapshot(snapshot_id: RowId, db: Db, caller: CurrentCaller) -> BufferSnapshot:
    """The snapshot that the path names."""
    return repository.snapshot(db, snapshot_id, caller)


CurrentPolicy = Annotated[Policy, Depends(current_policy)]


CurrentSnapshot = Annotated[BufferSnapshot, Depends(current_snapshot)]


def current_sweep(sweep_id: RowId, db: Db, caller: CurrentCaller) -> Sweep:
    """The sweep that the path names."""
    return repository.sweep(db, sweep_id, caller)


CurrentSweep = Annotated[Sweep, Depends(current_sweep)]
