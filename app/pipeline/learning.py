"""Background work of learning: the kinds `train` and `distill`, and their stages for longer jobs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.learning import repository
from app.learning.models import BufferSnapshot, Policy
from app.learning.policies import service
from app.learning.schemas import ALGORITHM_NAMES, DistilParams, TrainParams
from app.learning.snapshots import service as snapshots
from app.learning.sweeps import service as sweeps
from app.learning.sweeps.service import Group
from app.learning.training.configs import distillation_config, training_groups
from app.platform.errors import Invalid
from app.platform.jobs import JobContext, job_kind
from app.study.models import Participant

TRAIN_WEIGHT, YARDSTICK_WEIGHT, DISTIL_WEIGHT, STORE_WEIGHT = 10.0, 3.0, 2.0, 0.1
YARDSTICKS = "yardsticks"
Call = tuple[str, str, dict[str, Any]]


def acting(job: JobContext) -> Caller:
    """Whoever submitted the job; what it may do was checked then."""
    return Caller(label=job.created_by, user_id=None, grants=(), is_system=True)


def participant_of(db: Session, job: JobContext) -> Participant:
    """The job's participant."""
    if job.participant_id is None:
        raise Invalid(f"A job of kind '{job.kind}' needs a participant.", "Start it from the participant's page.")
    return db.get_one(Participant, job.participant_id)


def take_snapshot(job: JobContext, db: Session) -> BufferSnapshot:
    """The snapshot that everything in this job rests on."""
    return snapshots.take_snapshot(db, participant_of(db, job), acting(job))


def snapshot_facts(snapshot: BufferSnapshot) -> dict[str, Any]:
    """What later steps need to know of a snapshot."""
    return {"id": snapshot.id, "sha256": snapshot.file_sha256, "sessions": snapshot.sessions, "steps": snapshot.steps}


def training_starts(db: Session, participant_id: int, params: TrainParams) -> list[dict[str, Any] | None]:
    """Where each training starts: None from scratch, else the parent's id, algorithm and files.

    Raises:
        NotFound: no such policy. Invalid: a policy that cannot be trained further, or takes other windows than the settings say.
    """
    if not params.policies:
        return [None] * params.count
    starts: list[dict[str, Any] | None] = []
    for policy in repository.policies_named(db, participant_id, params.policies):
        if policy.kind not in ("trained", "distilled"):
            raise Invalid(
                f"Policy '{policy.name}' is {policy.kind}: only policies trained here can be trained further.", "Choose a trained policy."
            )
        service.require_window(policy, db.get_one(Participant, participant_id).current_settings.window)
        known = {"checkpoint_sha256": policy.checkpoint_sha256} if policy.checkpoint_sha256 else {"onnx_sha256": policy.onnx_sha256}
        # a student has no critic: the sweep's own algorithm goes on from it
        algorithm = policy.algorithm if policy.checkpoint_sha256 else params.algorithms[0]
        starts.append({"policy_id": policy.id, "algorithm": algorithm, **known})
    return starts


def training_calls(params: TrainParams, sha256: str, groups: Sequence[Group]) -> list[Call]:
    """Compute steps of the training stage: the groups of policies, then the yardsticks."""
    calls: list[Call] = []
    for group in groups:
        call = {"snapshot_sha256": sha256, "algorithm": group["algorithm"], "configs": group["configs"], "held_out": params.held_out}
        if group["start"] is not None:
            call["initial"] = {name: value for name, value in group["start"].items() if name.endswith("sha256")}
        calls.append((group["key"], "train", call))
    return [*calls, (YARDSTICKS, "yardsticks", {"snapshot_sha256": sha256, "held_out": params.held_out, "seed": params.seed})]


def declare_training(job: JobContext, params: TrainParams) -> None:
    """Show the training stage from the start; what is fine-tuned is known once the plan is made."""
    if not params.policies:
        _declare_groups(job, training_groups(params, [None] * params.count))
    job.step(YARDSTICKS, "Score controllers without learning", weight=YARDSTICK_WEIGHT)
    job.step("store-policies", "Store the policies", weight=STORE_WEIGHT)


def _declare_groups(job: JobContext, groups: Sequence[Group]) -> None:
    first = 1
    for group in groups:
        count = len(group["configs"])
        numbers = f"policy {first}" if count == 1 else f"policies {first} to {first + count - 1}"
        job.step(group["key"], f"Train {numbers} ({ALGORITHM_NAMES[group['algorithm']]})", weight=TRAIN_WEIGHT * count)
        first += count


def store_trained(
    job: JobContext, params: TrainParams, snapshot_id: int, groups: Sequence[Group], results: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Store the training stage's sweep and policies; returns the policies' ids, names and files.

    Args:
        job, params: the job. snapshot_id: what was trained on.
        groups: as `training_groups` made them. results: of `training_calls`, in that order.
    """

    def store(db: Session) -> dict[str, Any]:
        policies = sweeps.store(
            db,
            job_id=job.id,
            created_by=job.created_by,
            snapshot=db.get_one(BufferSnapshot, snapshot_id),
            name=params.sweep,
            config=params.model_dump(mode="json"),
            groups=groups,
            results=results[:-1],
            workdirs=[job.workdir(group["key"]) for group in groups],
            yardsticks=(results[-1], job.workdir(YARDSTICKS)),
        )
        return {"policies": _facts(policies)}

    stored: list[dict[str, Any]] = job.transact("store-policies", store)["policies"]
    return stored


def declare_distillation(job: JobContext, count: int) -> None:
    """Show the distillation stage, where the number of teachers is known."""
    for k in range(count):
        job.step(f"distil/{k}", f"Distil policy {k + 1}", weight=DISTIL_WEIGHT)
    job.step("store-students", "Store the small policies", weight=STORE_WEIGHT)


def distil_all(job: JobContext, params: DistilParams, snapshot: dict[str, Any], teachers: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The distillation stage; returns ids, names and files of the students."""
    calls: list[Call] = [
        (
            f"distil/{k}",
            "distil",
            {"snapshot_sha256": snapshot["sha256"], "teacher_sha256": teacher["sha256"], "config": distillation_config(params, k)},
        )
        for k, teacher in enumerate(teachers)
    ]
    results = job.compute_all(calls)

    def store(db: Session) -> dict[str, Any]:
        row = db.get_one(BufferSnapshot, snapshot["id"])
        steps = [
            (f"distil/{k}", result, job.workdir(f"distil/{k}"), teacher["id"])
            for k, (result, teacher) in enumerate(zip(results, teachers, strict=True))
        ]
        return {"policies": _facts(service.store_students(db, job.id, job.created_by, row, steps))}

    stored: list[dict[str, Any]] = job.transact("store-students", store)["policies"]
    return stored


@job_kind("train", title="Train policies", params_schema=TrainParams)
def run_train(job: JobContext) -> dict[str, Any]:
    """Train policies on a fresh snapshot."""
    params = TrainParams.model_validate(job.params)
    job.step("plan", "Take a buffer snapshot", weight=STORE_WEIGHT)
    declare_training(job, params)

    def plan(db: Session) -> dict[str, Any]:
        snapshot = take_snapshot(job, db)
        return {"snapshot": snapshot_facts(snapshot), "starts": training_starts(db, snapshot.participant_id, params)}

    planned = job.transact("plan", plan)
    groups = training_groups(params, planned["starts"])
    results = job.compute_all(training_calls(params, planned["snapshot"]["sha256"], groups))
    policies = store_trained(job, params, planned["snapshot"]["id"], groups, results)
    return {"snapshot_id": planned["snapshot"]["id"], "policy_ids": [p["id"] for p in policies]}


@job_kind("distill", title="Distil policies", params_schema=DistilParams)
def run_distil(job: JobContext) -> dict[str, Any]:
    """Distil the named policies, or every trained one that has no student."""
    params = DistilParams.model_validate(job.params)
    job.step("plan", "Take a buffer snapshot", weight=STORE_WEIGHT)

    def plan(db: Session) -> dict[str, Any]:
        snapshot = take_snapshot(job, db)
        return {"snapshot": snapshot_facts(snapshot), "teachers": _facts(teachers(db, snapshot.participant_id, params))}

    planned = job.transact("plan", plan)
    declare_distillation(job, len(planned["teachers"]))
    students = distil_all(job, params, planned["snapshot"], planned["teachers"])
    return {"snapshot_id": planned["snapshot"]["id"], "policy_ids": [p["id"] for p in students]}


def teachers(db: Session, participant_id: int, params: DistilParams) -> list[Policy]:
    """The policies to distil.

    Raises:
        NotFound: no such policy. Invalid: a baseline, or nothing to distil.
    """
    if params.policies:
        chosen = repository.policies_named(db, participant_id, params.policies)
        for policy in chosen:
            if policy.kind == "baseline":
                raise Invalid(f"Policy '{policy.name}' is a baseline: there is nothing to distil.", "Choose trained policies.")
        return chosen
    live = repository.candidates(db, participant_id)
    taught = {p.teacher_id for p in live}
    found = [p for p in live if p.kind == "trained" and p.id not in taught]
    if not found:
        raise Invalid("There is no trained policy without a student.", "Train policies first, or name the policies to distil.")
    return found


def _facts(policies: Sequence[Policy]) -> list[dict[str, Any]]:
    return [{"id": p.id, "name": p.name, "sha256": p.onnx_sha256} for p in policies]
