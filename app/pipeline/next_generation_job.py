"""The kind `next_generation`: assess what was tested, fine-tune the best, train fresh policies, distil, evaluate and rank, in one job."""

from __future__ import annotations

from typing import Any

from sqlalchemy.orm import Session

from app.learning.training_configs import generation_groups
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
from app.pipeline.next_generation import best, posterior_on, tested_policies
from app.pipeline.params import NextGenerationParams
from app.pipeline.stages import PLAN, STORE_WEIGHT, acting, participant_of, plan_on_snapshot, policy_facts
from app.pipeline.training import declare_training, store_trained, tested_so_far, training_calls, training_starts
from app.platform.errors import Invalid
from app.platform.jobs import JobContext, JobError
from app.tables.learning import BufferSnapshot, Policy

CHOOSE = "choose-parents"


def run_next_generation(job: JobContext) -> dict[str, Any]:
    """Choose the parents, fine-tune them and train fresh policies side by side, distil all, evaluate and rank."""
    params = NextGenerationParams.model_validate(job.params)
    training, evaluation = params.training(), params.evaluation()
    job.step(PLAN, "Pin the sessions to learn from", weight=STORE_WEIGHT)
    job.step(CHOOSE, "Choose the policies to go on from", weight=STORE_WEIGHT)
    planned = plan_on_snapshot(job, lambda db, snapshot: _plan(db, job, snapshot))
    snapshot = planned["snapshot"]
    starts = _starts(job, params, planned)
    groups = generation_groups(training, starts, params.tuned)
    declare_training(job, training, groups)
    declare_fit(job, evaluation)
    declare_distillation(job, sum(len(group["configs"]) for group in groups))
    declare_evaluation(job, evaluation, fit=False)
    trainings = training_calls(training, planned, groups)
    results = job.compute_all([*trainings, *fit_calls(evaluation, snapshot["sha256"])])
    policies = store_trained(job, training, snapshot["id"], groups, results[: len(trainings)])
    models = store_members(job, results[len(trainings) :])
    students = distil_all(job, params.distillation(), snapshot, policies)
    outcome = evaluate_all(job, evaluation, snapshot, models)
    made = [p["id"] for p in (*policies, *students)]
    return {"snapshot_id": snapshot["id"], "parent_ids": [s["policy_id"] for s in starts], "policy_ids": made} | outcome


def _plan(db: Session, job: JobContext, snapshot: BufferSnapshot) -> dict[str, Any]:
    """Read the tested policies, and their posterior returns where a ranking knows all sessions."""
    tested = [t.policy for t in tested_policies(db, participant_of(db, job))]
    plan = {"tested": policy_facts(tested), "tested_so_far": tested_so_far(db, snapshot, acting(job))}
    known = posterior_on(db, snapshot.participant_id, snapshot.id)
    if all(p.id in known for p in tested):
        return plan | {"posterior": {str(p.id): known[p.id] for p in tested}}
    return plan | {"posterior": None}


def _starts(job: JobContext, params: NextGenerationParams, planned: dict[str, Any]) -> list[dict[str, Any]]:
    """Choose the parents, the best first, as trainings start from them."""
    posterior = planned["posterior"]
    if posterior is None:
        declare_first_answer(job)
        found = first_answer(job, params.evaluation(), planned["snapshot"])
        if "failed" in found:
            raise JobError(f"Which tested policy did best is unknown: {found['failed']}. Start a 'pipeline' that names the policies.")
        posterior = found["returns"]

    def choose(db: Session) -> dict[str, Any]:
        tested = [db.get_one(Policy, p["id"]) for p in planned["tested"]]
        chosen = best(tested, {int(i): value for i, value in posterior.items()}, params.parents)
        if not chosen:
            raise Invalid("No policy that was tested can be trained further.", "Start a job of kind 'pipeline': it trains from scratch.")
        participant = participant_of(db, job)
        wanted = params.training().model_copy(update={"policies": [p.id for p in chosen]})
        return {"starts": training_starts(db, participant.id, wanted)}

    starts: list[dict[str, Any]] = job.transact(CHOOSE, choose)["starts"]
    return starts
