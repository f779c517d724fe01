"""Rows of margins as API types."""

from __future__ import annotations

from app.study.margins.models import MarginsLock
from app.study.margins.schemas import MarginsLockOut


def lock_out(lock: MarginsLock) -> MarginsLockOut:
    """A lock with the version that it locked."""
    return MarginsLockOut(version=lock.margins.version, reason=lock.reason, created_at=lock.created_at, created_by=lock.created_by)
