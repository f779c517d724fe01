"""Rules of policies: how they come in, what they are stored with, how they leave as a bundle. The caller commits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app import __version__
from app.accounts import policy as can
from app.accounts.policy import Caller
from app.learning import repository
from app.learning.baselines import ONNX
from app.learning.compute import POLICY, TRAINING, read_buffer
from app.learning.models import BufferSnapshot, Policy
from app.platform import files
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.platform.jobs.service import code_version
from app.study import repository as study_repository
from app.study import service as study
from app.study.models import Hemisphere, Participant, SettingsVersion, Visit
from ml.deploy.bundle import build_bundle
from ml.deploy.manifest import Approval, BundleError, BundleManifest
from ml.rl.onnx_policy import MAX_FILE_BYTES, OnnxPolicy, PolicyFileError

BUNDLE_TEST_WINDOWS = 64
UPLOAD_LIMIT = MAX_FILE_BYTES


@dataclass(frozen=True)
class Limits:
    """The clinician's limits of a bundle, mA and mA/s; None takes the default.

    Defaults: 0 mA to the cDBS amplitude, and a ramp that covers this range within one period, as the study's sessions had it.
    """

    min_ma: float | None = None
    max_ma: float | None = None
    ramp_ma_per_s: float | None = None


def add_external(db: Session, participant: Participant, name: str, content: bytes, file_name: str, caller: Caller) -> Policy:
    """Store a policy made elsewhere. It is run on beta windows of many scales, and on the participant's own where there are some.

    The file's name, which may name a person, stands in the answer to a bad file alone and is not kept.

    Raises:
        Invalid: the file is no such policy; says what is wrong with it. Conflict: the name is taken.
    """
    study.require(caller, can.WRITE_POLICIES, participant)
    settings = participant.current_settings
    newest = repository.newest_snapshot(db, participant.id)
    probe = _test_windows(newest, settings) if newest and _window_of(db, newest) == settings.window else None
    try:
        OnnxPolicy(content, settings.window, probe)
    except PolicyFileError as error:
        raise Invalid(
            f"'{file_name}' is no policy that betaloop can run: {error}.",
            f"Give an ONNX file with one input [N, {settings.window}] of beta windows, oldest first, and one output [N, 1] in [0, 1].",
        ) from error
    if repository.policy_by_name(db, participant.id, name):
        raise Conflict(f"Participant {participant.code} already has a policy '{name}'.", "Choose another name.")
    row = Policy(
        participant_id=participant.id,
        name=name,
        kind="external",
        algorithm="external",
        settings_version_id=settings.id,
        config={"window": settings.window},
        onnx_sha256=files.store(db, content, ONNX).sha256,
        metrics={"bytes": len(content)},
        code_version=__version__,
        created_by=caller.label,
    )
    db.add(row)
    try:
        db.flush()
    except IntegrityError as error:
        db.rollback()
        raise Conflict(f"Participant {participant.code} already has a policy '{name}'.", "Choose another name.") from error
    return row


def retire(db: Session, participant: Participant, policy: Policy, reason: str | None, caller: Caller) -> Policy:
    """Take a policy out of rankings and plans, or (no reason) back in; the policy itself stays as it is."""
    study.require(caller, can.WRITE_POLICIES, participant)
    policy.retired_reason = (reason or "").strip() or None
    set_reason(db, policy.retired_reason)
    db.flush()
    return policy


def store_trained(
    db: Session, job_id: str, created_by: str, snapshot: BufferSnapshot, steps: Sequence[tuple[str, dict[str, Any], Path, int | None]]
) -> list[Policy]:
    """Policies of a job's training steps; a step whose policy is there already gives that one.

    Args:
        db: the session. job_id: the job. created_by: who submitted it.
        snapshot: what they were trained on.
        steps: for each its key, its result, its working folder and the policy it was fine-tuned from.
    """
    repository.lock_participant(db, snapshot.participant_id)
    rows = []
    for key, result, workdir, parent_id in steps:
        row = repository.policy_of_step(db, job_id, key)
        if row is None:
            row = _trained_row(db, job_id, created_by, snapshot, key, result)
            row.parent_id = parent_id
            row.onnx_sha256 = files.store(db, (workdir / POLICY).read_bytes(), ONNX).sha256
            row.checkpoint_sha256 = files.store(db, (workdir / TRAINING).read_bytes(), "application/x-pytorch").sha256
            row.name = f"rl-{repository.trained_count(db, snapshot.participant_id) + 1:02d}"
            if repository.policy_by_name(db, snapshot.participant_id, row.name):
                row.name = _free_name(db, snapshot.participant_id, row.name)
            db.add(row)
            db.flush()
        rows.append(row)
    return rows


def store_students(
    db: Session, job_id: str, created_by: str, snapshot: BufferSnapshot, steps: Sequence[tuple[str, dict[str, Any], Path, int]]
) -> list[Policy]:
    """Students of a job's distillation steps, each with its key, result, working folder and teacher; as `store_trained`."""
    repository.lock_participant(db, snapshot.participant_id)
    rows = []
    for key, result, workdir, teacher_id in steps:
        row = repository.policy_of_step(db, job_id, key)
        if row is None:
            row = _trained_row(db, job_id, created_by, snapshot, key, result)
            row.kind, row.algorithm, row.teacher_id = "distilled", "distillation", teacher_id
            row.onnx_sha256 = files.store(db, (workdir / POLICY).read_bytes(), ONNX).sha256
            row.name = _free_name(db, snapshot.participant_id, f"{db.get_one(Policy, teacher_id).name[:80]}-small")
            db.add(row)
            db.flush()
        rows.append(row)
    return rows


def bundle(
    db: Session,
    participant: Participant,
    policy: Policy,
    limits: Limits | None = None,
    hemisphere: Hemisphere | None = None,
    approvals: Sequence[Approval] = (),
) -> bytes:
    """The controller bundle of a policy: a ZIP with the network, its manifest, test vectors and a one-page sheet.

    Raises:
        Invalid: the cDBS amplitude or the unit of beta is not known, or limits that contradict each other.
    """
    limits = limits or Limits()
    version = study_repository.settings_version(db, policy.settings_version_id)
    snapshot = db.get(BufferSnapshot, policy.snapshot_id) if policy.snapshot_id else None
    data = snapshot or repository.newest_snapshot(db, participant.id)
    unit = data.beta_unit if data else version.beta_unit
    source = data.beta_source if data else version.beta_source
    if unit is None or source is None:
        raise Invalid("The unit and source of beta are not known.", "Set beta_unit and beta_source in the participant's settings.")
    cdbs = _present_cdbs_ma(participant, hemisphere)
    try:
        manifest = BundleManifest(
            participant=participant.code,
            policy_id=policy.id,
            policy_name=policy.name,
            window=version.window,
            period_s=version.period_s,
            beta_unit=unit,
            beta_source=source,
            normalisation_mean=policy.metrics.get("beta_mean"),
            normalisation_std=policy.metrics.get("beta_std"),
            min_ma=0.0 if limits.min_ma is None else limits.min_ma,
            max_ma=cdbs if limits.max_ma is None else limits.max_ma,
            cdbs_ma=cdbs,
            ramp_ma_per_s=cdbs / version.period_s if limits.ramp_ma_per_s is None else limits.ramp_ma_per_s,
            snapshot_sha256=snapshot.file_sha256 if snapshot else None,
            code_version=policy.code_version,
            approvals=tuple(approvals),
        )
        usable = data if data and _window_of(db, data) == version.window else None
        return build_bundle(files.read(policy.onnx_sha256), manifest, _test_windows(usable, version))
    except (BundleError, PolicyFileError) as error:
        raise Invalid(f"The bundle of policy '{policy.name}' cannot be made: {error}.", "Correct what is named.") from error


def _present_cdbs_ma(participant: Participant, hemisphere: Hemisphere | None) -> float:
    """The cDBS amplitude in force now: the newest visit that states one (of this hemisphere), else the settings' shorthand."""
    for visit in sorted(participant.visits, key=_visit_number, reverse=True):
        stated = {a.amplitude_ma for a in visit.cdbs_amplitudes if hemisphere in (None, a.hemisphere)}
        if len(stated) == 1:
            return stated.pop()
        if stated:
            raise Invalid(f"Visit {visit.number} states several cDBS amplitudes.", "Name the hemisphere: left or right.")
    shorthand = participant.current_settings.cdbs_amplitude_ma
    if shorthand is None:
        raise Invalid("The cDBS amplitude is not known.", "Set cdbs_amplitude_ma in the participant's settings or at a visit.")
    return shorthand


def _visit_number(visit: Visit) -> int:
    return visit.number


def _test_windows(snapshot: BufferSnapshot | None, settings: SettingsVersion) -> NDArray[np.float64]:
    """Beta windows for test vectors: spread over the snapshot's states; without one, ramps around the threshold."""
    if snapshot is not None:
        states = read_buffer(snapshot.file_sha256).transitions().states
        return np.asarray(states[np.unique(np.linspace(0, len(states) - 1, BUNDLE_TEST_WINDOWS).astype(int))])
    level = settings.xi_beta if settings.xi_beta else 1.0
    shares = np.linspace(0.0, 2.0, BUNDLE_TEST_WINDOWS)[:, None]
    return np.asarray(level * shares * np.linspace(0.5, 1.5, settings.window)[None, :])


def _window_of(db: Session, snapshot: BufferSnapshot) -> int:
    return study_repository.settings_version(db, snapshot.settings_version_id).window


def _trained_row(db: Session, job_id: str, created_by: str, snapshot: BufferSnapshot, key: str, result: dict[str, Any]) -> Policy:
    return Policy(
        participant_id=snapshot.participant_id,
        kind="trained",
        algorithm="ddpg",
        snapshot_id=snapshot.id,
        settings_version_id=snapshot.settings_version_id,
        job_id=job_id,
        job_step=key,
        config=result["config"],
        seed=result["config"]["seed"],
        metrics=result["metrics"],
        code_version=code_version(),
        created_by=created_by,
    )


def _free_name(db: Session, participant_id: int, wish: str) -> str:
    """The wish, or with the first free number behind it."""
    taken = repository.names_in_use(db, participant_id, wish)
    if wish not in taken:
        return wish
    return next(name for name in (f"{wish}-{n}" for n in range(2, len(taken) + 3)) if name not in taken)
