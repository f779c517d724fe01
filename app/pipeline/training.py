"""The kind `train`, and its stage for longer jobs: train the policies of a sweep, score controllers without learning, store both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.evaluation.policies.tested import tested
from app.learning import policies, repository, sweeps
from app.learning.schemas import ALGORITHM_NAMES, TrainParams
from app.learning.sweeps import Group
from app.learning.training_configs import HELD_BY, training_groups
from app.learning.trajectories import read_buffer
from app.pipeline.stages import PLAN, STORE_WEIGHT, ComputeStep, acting, plan_on_snapshot, policy_facts
from app.platform.errors import Invalid
from app.platform.jobs import JobContext
from app.tables.learning import BufferSnapshot
from app.tables.participants import Participant

TRAIN_WEIGHT, BASELINES_WEIGHT = 10.0, 3.0
BASELINES = "baselines"


def run_train(job: JobContext) -> dict[str, Any]:
    """Train policies on a fresh snapshot."""
    params = TrainParams.model_validate(job.params)
    job.step(PLAN, "Pin the sessions to learn from", weight=STORE_WEIGHT)
    declare_training(job, params)
    planned = plan_on_snapshot(job, lambda db, snapshot: training_plan(db, snapshot, params, acting(job)))
    groups = training_groups(params, planned["starts"])
    results = job.compute_all(training_calls(params, planned, groups))
    policies = store_trained(job, params, planned["snapshot"]["id"], groups, results)
    return {"snapshot_id": planned["snapshot"]["id"], "policy_ids": [p["id"] for p in policies]}


def training_plan(db: Session, snapshot: BufferSnapshot, params: TrainParams, caller: Caller) -> dict[str, Any]:
    """Read what the training stage needs before it begins: `starts` and `tested_so_far`, as the functions give them."""
    return {"starts": training_starts(db, snapshot.participant_id, params), "tested_so_far": tested_so_far(db, snapshot, caller)}


def tested_so_far(db: Session, snapshot: BufferSnapshot, caller: Caller) -> dict[str, Any]:
    """Collect what sessions of policies showed, as the evaluation of the same snapshot would know it; sweeps use it too.

    Returns:
        `tests`, as `Tested` has them, and `policies` that they are of, retired ones too, as [{`id`, `sha256`}].
    """
    found = tested(db, snapshot, read_buffer(snapshot.file_sha256), snapshot.median_steps, caller)
    return {"tests": found.tests, "policies": found.beside(())}


def training_starts(db: Session, participant_id: int, params: TrainParams) -> list[dict[str, Any] | None]:
    """Find the start of each training: None from scratch, else the parent's id, algorithm and files.

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
        policies.require_window(policy, db.get_one(Participant, participant_id).current_settings.window)
        known = {"checkpoint_sha256": policy.checkpoint_sha256} if policy.checkpoint_sha256 else {"onnx_sha256": policy.onnx_sha256}
        # a student has no critic: the sweep's own algorithm goes on from it
        algorithm = policy.algorithm if policy.checkpoint_sha256 else params.algorithms[0]
        own = {name: policy.config[name] for name in ("aim", *HELD_BY) if name in policy.config}
        starts.append({"policy_id": policy.id, "algorithm": algorithm, "trained_with": own, **known})
    return starts


def training_calls(params: TrainParams, planned: Mapping[str, Any], groups: Sequence[Group]) -> list[ComputeStep]:
    """Compute steps of the training stage: the groups of policies, then the baselines.

    `planned` has `snapshot` as `stages.snapshot_facts` makes it, and `tested_so_far` as the function gives it.
    """
    snapshot = planned["snapshot"]
    common = {
        "snapshot_sha256": snapshot["sha256"],
        "held_out": params.held_out,
        "margins": snapshot["margins"],
        "tested": planned["tested_so_far"],
    }
    calls: list[ComputeStep] = []
    for group in groups:
        call = {**common, "algorithm": group["algorithm"], "configs": group["configs"]}
        if group["start"] is not None:
            call["initial"] = {name: value for name, value in group["start"].items() if name.endswith("sha256")}
        calls.append((group["key"], "train", call))
    return [*calls, (BASELINES, "baselines", {**common, "seed": params.seed})]


def declare_training(job: JobContext, params: TrainParams, groups: Sequence[Group] | None = None) -> None:
    """Show the training stage; without `groups` from the start, where what is fine-tuned is known once the plan is made."""
    if groups is not None:
        _declare_groups(job, groups)
    elif not params.policies:
        _declare_groups(job, training_groups(params, [None] * params.count))
    job.step(BASELINES, "Score controllers without learning", weight=BASELINES_WEIGHT)
    job.step("store-policies", "Store the policies", weight=STORE_WEIGHT)


def _declare_groups(job: JobContext, groups: Sequence[Group]) -> None:
    first = 1
    for group in groups:
        count = len(group["configs"])
        numbers = f"policy {first}" if count == 1 else f"policies {first} to {first + count - 1}"
        how = "Train" if group["start"] is None else "Fine-tune"
        job.step(group["key"], f"{how} {numbers} ({ALGORITHM_NAMES[group['algorithm']]})", weight=TRAIN_WEIGHT * count)
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
            baselines=(results[-1], job.workdir(BASELINES)),
        )
        return {"policies": policy_facts(policies)}

    stored: list[dict[str, Any]] = job.transact("store-policies", store)["policies"]
    return stored
