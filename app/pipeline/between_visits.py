"""The kind `pipeline`: everything between two visits in one job. Snapshot, first answer, train, distil, fit, estimate, rank."""

from __future__ import annotations

from typing import Any

from app.learning.training_configs import training_groups
from app.pipeline.distillation import declare_distillation, distil_all
from app.pipeline.evaluation import (
    declare_evaluation,
    declare_first_answer,
    declare_fit,
    evaluate_all,
    first_answer,
    fit_calls,
    store_members,
)
from app.pipeline.params import PipelineParams
from app.pipeline.stages import PLAN, STORE_WEIGHT, acting, plan_on_snapshot
from app.pipeline.training import declare_training, store_trained, training_calls, training_plan
from app.platform.jobs import JobContext


def run_pipeline(job: JobContext) -> dict[str, Any]:
    """Run all steps: snapshot, first answer, train, distil, fit the DLSM, estimate, rank. Training and fitting run side by side."""
    params = PipelineParams.model_validate(job.params)
    training, evaluation = params.training(), params.evaluation()
    job.step(PLAN, "Pin the sessions to learn from", weight=STORE_WEIGHT)
    declare_first_answer(job)
    declare_training(job, training)
    declare_fit(job, evaluation)
    declare_distillation(job, len(params.policies) or params.count)
    declare_evaluation(job, evaluation, fit=False)
    planned = plan_on_snapshot(job, lambda db, snapshot: training_plan(db, snapshot, training, acting(job)))
    snapshot = planned["snapshot"]
    first_answer(job, evaluation, snapshot)
    groups = training_groups(training, planned["starts"])
    trainings = training_calls(training, planned, groups)
    results = job.compute_all([*trainings, *fit_calls(evaluation, snapshot["sha256"])])
    policies = store_trained(job, training, snapshot["id"], groups, results[: len(trainings)])
    models = store_members(job, results[len(trainings) :])
    students = distil_all(job, params.distillation(), snapshot, policies)
    outcome = evaluate_all(job, evaluation, snapshot, models)
    return {"snapshot_id": snapshot["id"], "policy_ids": [p["id"] for p in (*policies, *students)]} | outcome
