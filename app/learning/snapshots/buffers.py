"""The replay buffer of a stored snapshot."""

from __future__ import annotations

from app.platform import files
from ml.trajectories import ReplayBuffer, from_parquet


def read_buffer(sha256: str) -> ReplayBuffer:
    """Read a stored snapshot's buffer, by the hash of its file."""
    return from_parquet(files.read(sha256))
