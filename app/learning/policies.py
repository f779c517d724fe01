"""Policies of a participant: trained, external and baseline ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from fastapi import UploadFile
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app import __version__
from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.learning import foreign, repository
from app.learning.training_configs import POLICY
from app.learning.trajectories import read_buffer
from app.platform import files
from app.platform.database import end_reading, set_reason
from app.platform.errors import Conflict, Invalid, TooLarge
from app.platform.jobs.service import code_version
from app.study import access
from app.study import repository as study_repository
from app.tables.learning import BufferSnapshot, Policy
from app.tables.participants import Participant, SettingsVersion
from ml.policies.from_buffer import proportional_from_buffer
from ml.policies.onnx_policy import MAX_FILE_BYTES, OnnxPolicy, PolicyFileError
from ml.policies.policy import ProportionalPolicy
from ml.trajectories import ReplayBuffer

# Controllers without learning, as policies of a participant, that every ranking compares with its candidates.
#
# They are ONNX files like any other policy, so that they are estimated, bundled and tested in the same way.


CONSTANTS = (1.0, 0.85, 0.7, 0.55, 0.4)
"""Constant amplitude fractions: cDBS, and a grid from which a ranking names the best."""

_OPSET, _IR_VERSION = 17, 8


def ensure_baselines(
    db: Session, participant: Participant, snapshot: BufferSnapshot, buffer: ReplayBuffer, created_by: str
) -> list[Policy]:
    """Return the participant's baseline policies and make missing ones. Constants are made once per window length. Proportional control
    between quantiles of the beta amplitudes (0.25 and 0.9) is made once from the first snapshot in a unit and source of beta. The clone of
    the snapshot's logged behaviour is added where a sweep has made one.
    """
    window = buffer.settings.window
    made = {p.name: p for p in repository.baselines(db, participant.id)}
    suffix = "" if window == 10 else f" (W {window})"
    for fraction in CONSTANTS:
        name = ("cDBS (constant 1.00)" if fraction == 1 else f"constant {fraction:.2f}") + suffix
        if name not in made:
            config = {"controller": "constant", "amplitude": fraction, "window": window}
            made[name] = _add(db, participant, snapshot, name, "constant", config, constant_onnx(fraction, window), created_by)
    name = f"proportional to beta in {snapshot.beta_unit} from {snapshot.beta_source}{suffix}"
    proportional = _proportional(buffer)
    if name not in made and proportional is not None:
        config = {"controller": "proportional", "low": proportional.low, "high": proportional.high, "window": window}
        made[name] = _add(db, participant, snapshot, name, "proportional", config, proportional_onnx(proportional, window), created_by)
    return [
        p
        for p in made.values()
        if p.config.get("window") == window and (p.algorithm == "constant" or p.name == name or p.snapshot_id == snapshot.id)
    ]


def constant_onnx(amplitude: float, window: int) -> bytes:
    """Write a policy file that answers every beta window with the same amplitude fraction."""
    shape = [
        helper.make_node("Shape", ["beta_window"], ["shape"]),
        helper.make_node("Gather", ["shape", "first"], ["count"]),
        helper.make_node("Concat", ["count", "one"], ["answer_shape"], axis=0),
        helper.make_node(
            "ConstantOfShape",
            ["answer_shape"],
            ["amplitude_fraction"],
            value=helper.make_tensor("value", TensorProto.FLOAT, [1], [amplitude]),
        ),
    ]
    return _model(shape, {"first": np.array([0], dtype=np.int64), "one": np.array([1], dtype=np.int64)}, window)


def proportional_onnx(policy: ProportionalPolicy, window: int) -> bytes:
    """Write a policy file of proportional control."""
    gain = (1 - policy.floor) / (policy.high - policy.low)
    nodes = [
        helper.make_node("Slice", ["beta_window", "start", "stop", "axis"], ["newest"]),
        helper.make_node("ReduceMean", ["newest"], ["level"], axes=[1], keepdims=1),
        helper.make_node("Sub", ["level", "low"], ["above"]),
        helper.make_node("Mul", ["above", "gain"], ["rise"]),
        helper.make_node("Add", ["rise", "floor"], ["wish"]),
        helper.make_node("Clip", ["wish", "floor", "top"], ["amplitude_fraction"]),
    ]
    numbers = {"low": policy.low, "gain": gain, "floor": policy.floor, "top": 1.0}
    constants = {name: np.array(value, dtype=np.float32) for name, value in numbers.items()}
    indices = {"start": window - policy.newest, "stop": window, "axis": 1}
    return _model(nodes, constants | {name: np.array([value], dtype=np.int64) for name, value in indices.items()}, window)


def _proportional(buffer: ReplayBuffer) -> ProportionalPolicy | None:
    """Build proportional control for this buffer; None where beta has no spread to be proportional to."""
    try:
        return proportional_from_buffer(buffer)
    except ValueError:
        return None


def _model(nodes: list[onnx.NodeProto], constants: dict[str, NDArray[Any]], window: int) -> bytes:
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("beta_window", TensorProto.FLOAT, ["N", window])],
        [helper.make_tensor_value_info("amplitude_fraction", TensorProto.FLOAT, ["N", 1])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, producer_name="betaloop", ir_version=_IR_VERSION, opset_imports=[helper.make_opsetid("", _OPSET)])
    return bytes(model.SerializeToString(deterministic=True))


def _add(
    db: Session,
    participant: Participant,
    snapshot: BufferSnapshot,
    name: str,
    algorithm: str,
    config: dict[str, object],
    content: bytes,
    created_by: str,
) -> Policy:
    row = Policy(
        participant_id=participant.id,
        name=name,
        kind="baseline",
        algorithm=algorithm,
        snapshot_id=snapshot.id if algorithm == "proportional" else None,
        settings_version_id=snapshot.settings_version_id,
        config=config,
        onnx_sha256=files.store(db, content).sha256,
        metrics={},
        code_version=__version__,
        created_by=created_by,
    )
    db.add(row)
    db.flush()
    return row


# Rules of policies: how they come in, what they are stored with, how they leave is in `bundles.py`. The caller commits.

BUNDLE_TEST_WINDOWS = 64
FOREIGN = "external"
"""Kind of a policy that was made elsewhere and uploaded."""
UPLOAD_LIMIT = MAX_FILE_BYTES


def window_of(policy: Policy) -> int:
    """Find the W that a policy takes: what an uploaded one was tried with, else what its file says."""
    own = policy.config.get("window") if policy.kind == FOREIGN else None
    return int(own) if own else OnnxPolicy(onnx_of(policy)).window


def onnx_of(policy: Policy) -> bytes:
    """Read the stored ONNX file of a policy. Raises Invalid, naming the policy, where it is missing or damaged."""
    try:
        return files.read(policy.onnx_sha256)
    except files.MissingFile as error:
        raise Invalid(
            f"The stored file of policy '{policy.name}' is missing or damaged.",
            "Ask your administrator to restore it from a backup of the data folder, or leave the policy out or retire it.",
        ) from error


def require_window(policy: Policy, window: int) -> None:
    """Raise Invalid where a policy takes other windows than the participant's settings say now."""
    if (own := window_of(policy)) != window:
        raise Invalid(
            f"Policy '{policy.name}' takes windows of {own} beta amplitudes; the participant's settings say {window}.",
            "Leave it out, or set the window back.",
        )


def add_external(db: Session, participant: Participant, name: str, content: bytes, file_name: str, caller: Caller) -> Policy:
    """Store a policy made elsewhere. It is tried, in a child, on beta windows of many scales, and on the participant's own if any.

    The file's name, which may name a person, is part of the answer to a bad file alone and is not stored.

    Raises:
        Invalid: the file is no such policy; says what is wrong with it. Conflict: the name is taken.
    """
    access.require(caller, can.WRITE_POLICIES, participant)
    settings = participant.current_settings
    newest = repository.newest_snapshot(db, participant.id)
    probe = probe_windows(newest, settings) if newest and _window_of(db, newest) == settings.window else None
    try:
        foreign.judge(content, settings.window, probe)
    except PolicyFileError as error:
        raise Invalid(
            f"'{file_name}' is no policy that betaloop can run: {error}.",
            f"Give an ONNX file with one input [N, {settings.window}] of beta windows, oldest first, and one output [N, 1] in [0, 1].",
            field="file",
        ) from error
    if repository.policy_by_name(db, participant.id, name):
        raise Conflict(f"Participant {participant.code} already has a policy '{name}'.", "Choose another name.", field="name")
    end_reading(db)
    row = Policy(
        participant_id=participant.id,
        name=name,
        kind=FOREIGN,
        algorithm="external",
        settings_version_id=settings.id,
        config={"window": settings.window},
        onnx_sha256=files.store(db, content).sha256,
        metrics={"bytes": len(content)},
        code_version=__version__,
        created_by=caller.label,
    )
    db.add(row)
    try:
        db.flush()
    except IntegrityError as error:
        db.rollback()
        raise Conflict(f"Participant {participant.code} already has a policy '{name}'.", "Choose another name.", field="name") from error
    return row


def retire(db: Session, participant: Participant, policy: Policy, reason: str | None, caller: Caller) -> Policy:
    """Take a policy out of rankings and plans, or (no reason) back in; the policy itself stays as it is.

    Raises:
        NotFound: the policy is another participant's. Forbidden: the caller may not change policies.
    """
    access.require(caller, can.WRITE_POLICIES, participant)
    access.require_own(participant, policy, f"policy {policy.id}")
    policy.retired_reason = (reason or "").strip() or None
    set_reason(db, policy.retired_reason)
    db.flush()
    return policy


def store_students(
    db: Session, job_id: str, created_by: str, snapshot: BufferSnapshot, steps: Sequence[tuple[str, dict[str, Any], Path, int]]
) -> list[Policy]:
    """Store the students of a job's distillation steps, each with its key, result, working folder and teacher.

    A step whose student is there already gives that one.
    """
    repository.lock_participant(db, snapshot.participant_id)
    rows = []
    for key, result, workdir, teacher_id in steps:
        row = repository.policy_of_step(db, job_id, key)
        if row is None:
            row = _student_row(job_id, created_by, snapshot, key, result)
            row.teacher_id = teacher_id
            row.onnx_sha256 = files.store(db, (workdir / POLICY).read_bytes()).sha256
            row.name = free_name(db, snapshot.participant_id, f"{db.get_one(Policy, teacher_id).name[:80]}-small")
            db.add(row)
            db.flush()
        rows.append(row)
    return rows


def probe_windows(snapshot: BufferSnapshot | None, settings: SettingsVersion) -> NDArray[np.float64]:
    """Choose beta windows for test vectors: spread over the snapshot's states; without one, ramps around the threshold."""
    if snapshot is not None:
        states = read_buffer(snapshot.file_sha256).transitions().states
        return np.asarray(states[np.unique(np.linspace(0, len(states) - 1, BUNDLE_TEST_WINDOWS).astype(int))])
    level = settings.xi_beta if settings.xi_beta else 1.0
    shares = np.linspace(0.0, 2.0, BUNDLE_TEST_WINDOWS)[:, None]
    return np.asarray(level * shares * np.linspace(0.5, 1.5, settings.window)[None, :])


def _window_of(db: Session, snapshot: BufferSnapshot) -> int:
    return study_repository.settings_version(db, snapshot.settings_version_id).window


def _student_row(job_id: str, created_by: str, snapshot: BufferSnapshot, key: str, result: dict[str, Any]) -> Policy:
    return Policy(
        participant_id=snapshot.participant_id,
        kind="distilled",
        algorithm="distillation",
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


def free_name(db: Session, participant_id: int, wish: str) -> str:
    """Return the wanted name, or with the first free number behind it."""
    taken = repository.names_in_use(db, participant_id, wish)
    if wish not in taken:
        return wish
    return next(name for name in (f"{wish}-{n}" for n in range(2, len(taken) + 3)) if name not in taken)


# The bytes of a policy file that arrives by form or REST.


def read_limited(file: UploadFile) -> bytes:
    """Read the bytes of an uploaded policy. Raises TooLarge."""
    content = file.file.read(UPLOAD_LIMIT + 1)
    if len(content) > UPLOAD_LIMIT:
        raise TooLarge(
            f"'{file.filename}' is larger than {UPLOAD_LIMIT >> 20} MiB.",
            "A policy of the study's kind has some kilobytes.",
            field="file",
        )
    return content
