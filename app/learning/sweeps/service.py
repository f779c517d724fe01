"""Sweeps: which policies are trained in one action, where they are stored, and how they compare. The caller commits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sqlalchemy.orm import Session

from app.learning import repository
from app.learning.policies.service import free_name
from app.learning.training.results import CLONE, policy_file, training_file
from app.platform import files
from app.platform.jobs.service import code_version
from app.study import repository as study_repository
from app.tables.learning import BufferSnapshot, Policy, Sweep

Group = dict[str, Any]
"""Policies trained side by side in one child process: `key`, `algorithm`, `configs`, `start` (None from scratch)."""


def store(
    db: Session,
    *,
    job_id: str,
    created_by: str,
    snapshot: BufferSnapshot,
    name: str | None,
    config: dict[str, Any],
    groups: Sequence[Group],
    results: Sequence[dict[str, Any]],
    workdirs: Sequence[Path],
    baselines: tuple[dict[str, Any], Path],
) -> list[Policy]:
    """Store a sweep and its policies; a job that has stored its sweep already gets those policies again.

    Args:
        db: the session.
        job_id, created_by: the job and who submitted it.
        snapshot: what the policies were trained on.
        name: of the sweep; numbered where None or taken.
        config: what was asked for.
        groups, results, workdirs: one for each child process, in one order.
        baselines: result and folder of the step that scored controllers without learning.
    """
    repository.lock_participant(db, snapshot.participant_id)
    known = repository.sweep_of_job(db, job_id)
    if known is not None:
        return list(known.policies)
    sweep = Sweep(
        participant_id=snapshot.participant_id,
        name=_free_sweep_name(db, snapshot.participant_id, name),
        snapshot_id=snapshot.id,
        job_id=job_id,
        config=config,
        baselines=baselines[0],
        code_version=code_version(),
        created_by=created_by,
    )
    db.add(sweep)
    db.flush()
    rows = [
        _policy(db, sweep, snapshot, group, member, result["members"][member], workdir)
        for group, result, workdir in zip(groups, results, workdirs, strict=True)
        for member in range(len(group["configs"]))
    ]
    _store_clone(db, sweep, snapshot, baselines[1])
    return rows


def _policy(
    db: Session, sweep: Sweep, snapshot: BufferSnapshot, group: Group, member: int, result: dict[str, Any], workdir: Path
) -> Policy:
    number = repository.trained_count(db, snapshot.participant_id) + 1
    start = group["start"]
    row = Policy(
        participant_id=snapshot.participant_id,
        name=free_name(db, snapshot.participant_id, f"rl-{number:02d}"),
        kind="trained",
        algorithm=group["algorithm"],
        parent_id=start["policy_id"] if start else None,
        snapshot_id=snapshot.id,
        settings_version_id=snapshot.settings_version_id,
        job_id=sweep.job_id,
        job_step=f"{group['key']}/{member}",
        sweep_id=sweep.id,
        config=result["config"],
        seed=result["config"]["seed"],
        metrics=result["metrics"],
        onnx_sha256=files.store(db, (workdir / policy_file(member)).read_bytes()).sha256,
        checkpoint_sha256=files.store(db, (workdir / training_file(member)).read_bytes()).sha256,
        code_version=code_version(),
        created_by=sweep.created_by,
    )
    db.add(row)
    db.flush()
    return row


def _store_clone(db: Session, sweep: Sweep, snapshot: BufferSnapshot, workdir: Path) -> None:
    """Store the clone of the logged behaviour as a baseline of this snapshot, once."""
    name = f"behaviour clone of snapshot {snapshot.id}"
    if repository.policy_by_name(db, snapshot.participant_id, name):
        return
    window = study_repository.settings_version(db, snapshot.settings_version_id).window
    db.add(
        Policy(
            participant_id=snapshot.participant_id,
            name=name,
            kind="baseline",
            algorithm="cloning",
            snapshot_id=snapshot.id,
            settings_version_id=snapshot.settings_version_id,
            config={"controller": "cloning", "window": window},
            metrics={},
            onnx_sha256=files.store(db, (workdir / CLONE).read_bytes()).sha256,
            code_version=code_version(),
            created_by=sweep.created_by,
        )
    )
    db.flush()


def _free_sweep_name(db: Session, participant_id: int, wish: str | None) -> str:
    taken = repository.sweep_names(db, participant_id)
    if wish and wish.strip() and wish.strip() not in taken:
        return wish.strip()
    stem = wish.strip() if wish and wish.strip() else "sweep"
    numbers = (f"{stem[:90]} {n}" for n in range(1 if stem == "sweep" else 2, len(taken) + 3))
    return next(name for name in numbers if name not in taken)
