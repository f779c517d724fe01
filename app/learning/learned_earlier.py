"""Policies that were learned earlier, on sessions that this installation has too: stored with where they come from. The caller commits."""

from __future__ import annotations

import hashlib
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.learning import repository
from app.learning.trajectories import read_buffer
from app.platform import files
from app.platform.errors import Conflict, Invalid
from app.study import access
from app.study import repository as study_repository
from app.tables.learning import BufferSnapshot, Policy
from app.tables.participants import Participant
from ml.policies.onnx_policy import OnnxPolicy, PolicyFileError
from ml.trajectories import ReplayBuffer, SessionTrajectory

_RELATIVE = 1e-6
"""Largest relative difference of two numbers that count as the same: what processors round differently."""


@dataclass(frozen=True, kw_only=True)
class Learned:
    """A policy as its training or distillation left it.

    Attributes:
        name: in the study. kind: `trained` or `distilled`. algorithm: key of what learned it.
        teacher, parent: names of the policies that it was distilled or fine-tuned from; None where there is none.
        config, metrics: as the compute step gave them. onnx: the file. code_version: of the betaloop that learned it.
    """

    name: str
    kind: str
    algorithm: str
    teacher: str | None
    parent: str | None
    config: dict[str, Any]
    metrics: dict[str, Any]
    onnx: bytes
    code_version: str


def add_learned(
    db: Session, participant: Participant, snapshot: BufferSnapshot, learnt_on: ReplayBuffer, learned: Learned, caller: Caller
) -> Policy:
    """Store a policy that was learned elsewhere or earlier on the very sessions of a snapshot; one that is there already is given back.

    Args:
        snapshot: of this participant. learnt_on: the buffer that the policy was learned on, whatever its sessions are numbered.

    Raises:
        Invalid: the snapshot holds other sessions than the policy was learned on, the file is no policy, or its teacher or parent is not
            here. Conflict: another policy has this name. Forbidden: the caller may not write policies.
    """
    access.require(caller, can.WRITE_POLICIES, participant)
    access.require_own(participant, snapshot, f"snapshot {snapshot.id}")
    known = repository.policy_by_name(db, participant.id, learned.name)
    if known is not None:
        if hashlib.sha256(learned.onnx).hexdigest() == known.onnx_sha256:
            return known
        raise Conflict(f"Participant {participant.code} has another policy '{learned.name}'.", "Choose another name.", field="name")
    difference = first_difference(read_buffer(snapshot.file_sha256), learnt_on)
    if difference is not None:
        raise Invalid(
            f"Policy '{learned.name}' was not learned on snapshot {snapshot.id}: {difference}.",
            "Add it as a policy made elsewhere instead: its file alone.",
        )
    window = study_repository.settings_version(db, snapshot.settings_version_id).window
    try:
        OnnxPolicy(learned.onnx, window)
    except PolicyFileError as error:
        raise Invalid(f"The file of policy '{learned.name}' cannot be run: {error}.", "Give the file that its training wrote.") from error
    row = Policy(
        participant_id=participant.id,
        name=learned.name,
        kind=learned.kind,
        algorithm=learned.algorithm,
        teacher_id=_named(db, participant, learned.name, learned.teacher),
        parent_id=_named(db, participant, learned.name, learned.parent),
        snapshot_id=snapshot.id,
        settings_version_id=snapshot.settings_version_id,
        config=learned.config,
        seed=learned.config.get("seed"),
        onnx_sha256=files.store(db, learned.onnx).sha256,
        metrics=learned.metrics,
        code_version=learned.code_version,
        created_by=caller.label,
    )
    db.add(row)
    db.flush()
    return row


def first_difference(stored: ReplayBuffer, learnt_on: ReplayBuffer) -> str | None:
    """Name the first number in which two buffers differ; None where all agree. Numbers of sessions and policies are not compared."""
    if stored.settings != learnt_on.settings:
        return "the settings are others"
    if len(stored.sessions) != len(learnt_on.sessions):
        return f"it holds {len(stored.sessions)} sessions and not {len(learnt_on.sessions)}"
    for place, (ours, theirs) in enumerate(zip(stored.sessions, learnt_on.sessions, strict=True), start=1):
        what = _difference(ours, theirs)
        if what is not None:
            return f"its session {place} has another {what}"
    return None


def _difference(ours: SessionTrajectory, theirs: SessionTrajectory) -> str | None:
    if ours.visit != theirs.visit:
        return "visit"
    if ours.controller != theirs.controller:
        return "controller"
    pairs = {"beta": (ours.beta, theirs.beta), "amplitude": (ours.amplitude, theirs.amplitude)}
    pairs["outcome"] = (_outcomes(ours), _outcomes(theirs))
    for what, (one, other) in pairs.items():
        if one.shape != other.shape or not np.allclose(one, other, rtol=_RELATIVE, atol=1e-9, equal_nan=True):
            return what
    return None


def _outcomes(session: SessionTrajectory) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([np.nan if v is None else v for v in astuple(session.qoc)], dtype=np.float64)


def _named(db: Session, participant: Participant, name: str, of: str | None) -> int | None:
    if of is None:
        return None
    found = repository.policy_by_name(db, participant.id, of)
    if found is None:
        raise Invalid(f"Policy '{name}' was made from '{of}', which participant {participant.code} does not have.", "Add that one first.")
    return found.id
