"""The kind `evaluate`, and its stages for longer jobs: fit the DLSM, check coverage, estimate by every method, rank by the posterior."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from app.evaluation import repository, service
from app.evaluation.estimates import compute, dose_shapes
from app.evaluation.schemas import EvaluateParams
from app.evaluation.tested import replayable, tested
from app.learning.policies.baselines import ensure_baselines
from app.learning.snapshots.buffers import read_buffer
from app.pipeline.stages import PLAN, STORE_WEIGHT, ComputeStep, acting, participant_of, plan_on_snapshot
from app.platform import files
from app.platform.jobs import JobContext
from app.study.repository import settings_version
from app.tables.learning import BufferSnapshot
from ml.ope import AGGREGATE, POSTERIOR, shown

FIT_WEIGHT = 15.0
COVERAGE_STEP = "coverage"
COVERAGE_WEIGHT = 1.0
SKILL_STEP = "choose-method"
SKILL_WEIGHT = 2.0


def run_evaluate(job: JobContext) -> dict[str, Any]:
    """Estimate the named policies, or all, on a fresh snapshot."""
    params = EvaluateParams.model_validate(job.params)
    job.step(PLAN, "Pin the sessions to learn from", weight=STORE_WEIGHT)
    declare_evaluation(job, params, fit=True)
    snapshot = plan_on_snapshot(job)["snapshot"]
    models = store_members(job, job.compute_all(fit_calls(params, snapshot["sha256"])))
    return {"snapshot_id": snapshot["id"]} | evaluate_all(job, params, snapshot, models)


def declare_evaluation(job: JobContext, params: EvaluateParams, *, fit: bool) -> None:
    """Show the evaluation stage from the start."""
    if fit:
        declare_fit(job, params)
    job.step("choose-policies", "Choose policies and references", weight=STORE_WEIGHT)
    job.step(COVERAGE_STEP, "Check what the data can say about each policy", weight=COVERAGE_WEIGHT)
    for method in _fitted(params):
        job.step(f"estimate/{method}", f"Estimate every policy: {shown(method).name}", weight=shown(method).weight)
    job.step(SKILL_STEP, "Hold the methods against controllers that were left out", weight=SKILL_WEIGHT)
    job.step("rank", "Store the estimates and rank", weight=STORE_WEIGHT)


def declare_fit(job: JobContext, params: EvaluateParams) -> None:
    """Show the fitting of the DLSM ensemble from the start."""
    for k in range(_members(params)):
        job.step(f"fit/{k}", f"Fit the deep latent sequential model, member {k + 1}", weight=FIT_WEIGHT)
    job.step("store-models", "Store the models", weight=STORE_WEIGHT)


def fit_calls(params: EvaluateParams, sha256: str) -> list[ComputeStep]:
    """Compute steps that fit the DLSM ensemble, one member each; none where the DLSM is not asked for."""
    common = {"snapshot_sha256": sha256, "preset": params.preset, "seed": params.seed}
    return [(f"fit/{k}", "fit_dlsm", common | {"member": k}) for k in range(_members(params))]


def store_members(job: JobContext, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Store the ensemble's files; `{"members": [hashes]}` or `{"failed": reason}`."""

    def store(db: Session) -> dict[str, Any]:
        reasons = [r["failed"] for r in results if "failed" in r]
        if reasons:
            return {"failed": reasons[0]}
        contents = [(job.workdir(f"fit/{k}") / compute.member_file(k)).read_bytes() for k in range(len(results))]
        return {"members": [files.store(db, content).sha256 for content in contents]}

    return job.transact("store-models", store)


def evaluate_all(job: JobContext, params: EvaluateParams, snapshot: dict[str, Any], models: dict[str, Any]) -> dict[str, Any]:
    """Check coverage, estimate candidates and references by every method, the posterior with what tested sessions showed, and rank."""

    def choose(db: Session) -> dict[str, Any]:
        row = db.get_one(BufferSnapshot, snapshot["id"])
        candidates = service.policies_to_rank(db, row.participant_id, params)
        buffer = read_buffer(row.file_sha256)
        participant = participant_of(db, job)
        references = ensure_baselines(db, participant, row, buffer, job.created_by)
        horizon = params.horizon_steps or row.median_steps
        everyone = (*candidates, *references)
        shown_by = tested(db, row, buffer, horizon, acting(job))
        driven = repository.policies_by_id(db, sorted({s.policy_id for s in buffer.sessions if s.policy_id is not None}))
        return {
            "candidates": [p.id for p in candidates],
            "ran": [{"id": p.id, "sha256": p.onnx_sha256} for p in driven.values() if replayable(p, buffer.settings.window)],
            "policies": [{"id": p.id, "sha256": p.onnx_sha256} for p in everyone],
            "horizon_steps": horizon,
            "tests": shown_by.tests,
            "tested": shown_by.beside({p.id for p in everyone}),
            "tests_left_out": shown_by.left_out,
            "others": dose_shapes.of_others(db, participant, settings_version(db, row.settings_version_id)),
        }

    chosen = job.transact("choose-policies", choose)
    common = {
        "snapshot_sha256": snapshot["sha256"],
        "preset": params.preset,
        "seed": params.seed,
        "horizon_steps": chosen["horizon_steps"],
        "policies": chosen["policies"],
    }
    methods = _fitted(params)
    others = chosen["others"]
    pooled = {"others": others["evidence"]} if others else {}
    shown_by = {name: chosen[name] for name in ("tests", "tested", "tests_left_out")}
    own: dict[str, dict[str, Any]] = {"dlsm": models, POSTERIOR: shown_by | pooled}
    calls: list[ComputeStep] = [(COVERAGE_STEP, "check_coverage", common)]
    calls += [(f"estimate/{method}", "evaluate_method", common | {"method": method} | own.get(method, {})) for method in methods]
    calls.append((SKILL_STEP, "choose_method", common | {"methods": params.methods, "policies": chosen["ran"]}))
    coverage, *estimates, skill = job.compute_all(calls)
    results = dict(zip(methods, estimates, strict=True))

    def store(db: Session) -> dict[str, Any]:
        row = service.store_evaluation(
            db,
            job_id=job.id,
            created_by=job.created_by,
            snapshot=db.get_one(BufferSnapshot, snapshot["id"]),
            horizon_steps=chosen["horizon_steps"],
            candidates=chosen["candidates"],
            results=results,
            config=params.model_dump(mode="json")
            | {"dlsm_members": models.get("members", [])}
            | ({"pooled_evaluations": others["evaluations"]} if others else {}),
            skill=skill,
            coverage=coverage,
        )
        return {"evaluation_id": row.id, "default_method": row.default_method}

    return job.transact("rank", store)


def _fitted(params: EvaluateParams) -> list[str]:
    """List methods with a compute step: all but the combination, which is computed from their estimates; the posterior always, as it
    ranks."""
    return [m for m in dict.fromkeys([*params.methods, POSTERIOR]) if m != AGGREGATE]


def _members(params: EvaluateParams) -> int:
    return compute.dlsm_members(params.preset, params.seed) if "dlsm" in params.methods else 0
