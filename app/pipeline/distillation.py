"""The kind `distill`, and its stage for longer jobs: distil policies into small ones and store them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from app.learning import policies, repository
from app.learning.schemas import DistilParams
from app.learning.training_configs import distillation_config
from app.pipeline.stages import PLAN, STORE_WEIGHT, ComputeStep, plan_on_snapshot, policy_facts
from app.platform.errors import Invalid
from app.platform.jobs import JobContext
from app.tables.learning import BufferSnapshot, Policy

DISTIL_WEIGHT = 2.0


def run_distil(job: JobContext) -> dict[str, Any]:
    """Distil the named policies, or every trained one that has no student."""
    params = DistilParams.model_validate(job.params)
    job.step(PLAN, "Pin the sessions to learn from", weight=STORE_WEIGHT)
    planned = plan_on_snapshot(job, lambda db, snapshot: {"teachers": policy_facts(teachers(db, snapshot.participant_id, params))})
    declare_distillation(job, len(planned["teachers"]))
    students = distil_all(job, params, planned["snapshot"], planned["teachers"])
    return {"snapshot_id": planned["snapshot"]["id"], "policy_ids": [p["id"] for p in students]}


def declare_distillation(job: JobContext, count: int) -> None:
    """Show the distillation stage, where the number of teachers is known."""
    for k in range(count):
        job.step(f"distil/{k}", f"Distil policy {k + 1}", weight=DISTIL_WEIGHT)
    job.step("store-students", "Store the small policies", weight=STORE_WEIGHT)


def distil_all(job: JobContext, params: DistilParams, snapshot: dict[str, Any], teachers: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Run the distillation stage; returns ids, names and files of the students."""
    calls: list[ComputeStep] = [
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
        return {"policies": policy_facts(policies.store_students(db, job.id, job.created_by, row, steps))}

    stored: list[dict[str, Any]] = job.transact("store-students", store)["policies"]
    return stored


def teachers(db: Session, participant_id: int, params: DistilParams) -> list[Policy]:
    """Choose the policies to distil.

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
