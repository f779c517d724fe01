"""The kind `evaluate`, and its stages for longer jobs: fit the DLSM, check coverage, estimate by every method, rank by the posterior.

A longer job gives a first answer before it trains: what is there already, and the references, by the posterior alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from app.evaluation import repository
from app.evaluation.estimates import compute, dose_shapes, service
from app.evaluation.policies.tested import replayable, tested
from app.evaluation.schemas import EvaluateParams
from app.learning import repository as learning
from app.learning.policies import ensure_baselines
from app.learning.trajectories import read_buffer
from app.pipeline.params import STEPS_MA, ThresholdRuleParams, rule_amplitudes
from app.pipeline.stages import PLAN, STORE_WEIGHT, ComputeStep, acting, participant_of, plan_on_snapshot, policy_facts
from app.platform import files
from app.platform.errors import Invalid
from app.platform.jobs import JobContext
from app.study.repository import settings_version
from app.tables.learning import BufferSnapshot
from ml.ope import AGGREGATE, POSTERIOR, shown

FIT_WEIGHT = 15.0
CHOOSE, COVERAGE, ESTIMATE, RANK = "choose-policies", "coverage", f"estimate/{POSTERIOR}", "rank"
COVERAGE_WEIGHT = 1.0
SKILL_STEP = "choose-method"
SKILL_WEIGHT = 2.0
FIRST = "first-answer/"
"""Head of the steps of a first answer."""


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
    job.step(CHOOSE, "Choose policies and references", weight=STORE_WEIGHT)
    job.step(COVERAGE, "Check what the data can say about each policy", weight=COVERAGE_WEIGHT)
    for method in _fitted(params):
        job.step(f"estimate/{method}", f"Estimate every policy: {shown(method).name}", weight=shown(method).weight)
    job.step(SKILL_STEP, "Hold the methods against controllers that were left out", weight=SKILL_WEIGHT)
    job.step(RANK, "Store the estimates and rank", weight=STORE_WEIGHT)


def declare_first_answer(job: JobContext) -> None:
    """Show the first answer from the start."""
    job.step(FIRST + CHOOSE, "First answer: choose policies and references", weight=STORE_WEIGHT)
    job.step(FIRST + COVERAGE, "First answer: check what the data can say about each policy", weight=COVERAGE_WEIGHT)
    job.step(FIRST + ESTIMATE, "First answer: estimate policies and references", weight=shown(POSTERIOR).weight)
    job.step(FIRST + RANK, "First answer: store the estimates", weight=STORE_WEIGHT)


def first_answer(job: JobContext, params: EvaluateParams, snapshot: dict[str, Any]) -> dict[str, Any]:
    """Estimate by the posterior what there is before any policy is trained, and store that as the ranking until the job's own is there.

    Returns:
        `returns`, the posterior's by policy id; or `failed` with the reason where it cannot work on these data, and then nothing is stored.
    """
    choice = _choose(job, params, snapshot, FIRST)
    coverage, found = job.compute_all(
        [
            (FIRST + COVERAGE, "check_coverage", _common(params, snapshot, choice)),
            (FIRST + ESTIMATE, "evaluate_method", _call(params, snapshot, choice, POSTERIOR)),
        ]
    )
    if "failed" in found:
        return found
    _store(job, params.model_copy(update={"methods": [POSTERIOR]}), snapshot, choice, {POSTERIOR: found}, coverage, head=FIRST)
    return {"returns": {policy_id: float(e["value"]) for policy_id, e in found["estimates"].items()}}


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
    choice = _choose(job, params, snapshot)
    methods, common = _fitted(params), _common(params, snapshot, choice)
    calls: list[ComputeStep] = [(COVERAGE, "check_coverage", common)]
    own = {"dlsm": models}
    calls += [(f"estimate/{m}", "evaluate_method", _call(params, snapshot, choice, m) | own.get(m, {})) for m in methods]
    calls.append((SKILL_STEP, "choose_method", common | {"methods": params.methods, "policies": choice["ran"]}))
    coverage, *estimates, skill = job.compute_all(calls)
    results = dict(zip(methods, estimates, strict=True))
    return _store(job, params, snapshot, choice, results, coverage, skill, members=models.get("members", []))


def _choose(job: JobContext, params: EvaluateParams, snapshot: dict[str, Any], head: str = "") -> dict[str, Any]:
    """Choose candidates and references, and collect what tested sessions and other participants say; a first answer needs no candidate."""

    def choose(db: Session) -> dict[str, Any]:
        row = db.get_one(BufferSnapshot, snapshot["id"])
        candidates = service.policies_to_rank(db, row.participant_id, params, least=0 if head else 1)
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

    return job.transact(head + CHOOSE, choose)


def _common(params: EvaluateParams, snapshot: dict[str, Any], choice: dict[str, Any]) -> dict[str, Any]:
    """Build the params that every compute step of an evaluation has."""
    named = {"preset": params.preset, "seed": params.seed, "horizon_steps": choice["horizon_steps"], "policies": choice["policies"]}
    return {"snapshot_sha256": snapshot["sha256"]} | named


def _call(params: EvaluateParams, snapshot: dict[str, Any], choice: dict[str, Any], method: str) -> dict[str, Any]:
    """Build the params of a method's step; the posterior alone knows of tests and of other participants."""
    own: dict[str, Any] = {}
    if method == POSTERIOR:
        own = {name: choice[name] for name in ("tests", "tested", "tests_left_out")}
        own |= {"others": choice["others"]["evidence"]} if choice["others"] else {}
    return _common(params, snapshot, choice) | {"method": method} | own


def _store(
    job: JobContext,
    params: EvaluateParams,
    snapshot: dict[str, Any],
    choice: dict[str, Any],
    results: dict[str, dict[str, Any]],
    coverage: dict[str, Any],
    skill: dict[str, Any] | None = None,
    *,
    members: Sequence[str] = (),
    head: str = "",
) -> dict[str, Any]:
    """Store an evaluation as the participant's newest; `head` is that of the steps of a first answer."""
    others = choice["others"]

    def store(db: Session) -> dict[str, Any]:
        row = service.store_evaluation(
            db,
            job_id=job.id,
            first_answer=bool(head),
            created_by=job.created_by,
            snapshot=db.get_one(BufferSnapshot, snapshot["id"]),
            horizon_steps=choice["horizon_steps"],
            candidates=choice["candidates"],
            results=results,
            config=params.model_dump(mode="json")
            | {"dlsm_members": list(members)}
            | ({"pooled_evaluations": others["evaluations"]} if others else {}),
            skill=skill,
            coverage=coverage,
        )
        return {"evaluation_id": row.id, "default_method": row.default_method}

    return job.transact(head + RANK, store)


def _fitted(params: EvaluateParams) -> list[str]:
    """List methods with a compute step: all but the combination, which is computed from their estimates; the posterior always, as it
    ranks."""
    return [m for m in dict.fromkeys([*params.methods, POSTERIOR]) if m != AGGREGATE]


def _members(params: EvaluateParams) -> int:
    return compute.dlsm_members(params.preset, params.seed) if "dlsm" in params.methods else 0


# The kind `threshold_rule`: the settings of an implant on the market that come closest to a policy.

FIND_RULE = "find-rule"


def run_threshold_rule(job: JobContext) -> dict[str, Any]:
    """Find the closest rule on a fresh snapshot."""
    params = ThresholdRuleParams.model_validate(job.params)
    job.step(PLAN, "Pin the sessions to learn from", weight=STORE_WEIGHT)
    job.step(FIND_RULE, "Find the closest rule and estimate its return", weight=1.0)

    def facts(db: Session, snapshot: BufferSnapshot) -> dict[str, Any]:
        cdbs_ma, limits = rule_amplitudes(participant_of(db, job), params)
        (policy,) = policy_facts(learning.policies_named(db, snapshot.participant_id, [params.policy_id]))
        settings = settings_version(db, snapshot.settings_version_id)
        return {
            "policy": policy,
            "cdbs_ma": cdbs_ma,
            "min_ma": limits.low_ma,
            "max_ma": limits.high_ma,
            "beta": {"unit": snapshot.beta_unit, "source": snapshot.beta_source, "low_hz": settings.beta_low_hz,
                     "high_hz": settings.beta_high_hz, "period_s": settings.period_s},
            "horizon_steps": snapshot.median_steps,
        }  # fmt: skip

    planned = plan_on_snapshot(job, facts)
    snapshot = planned["snapshot"]
    margins = dict(snapshot["margins"])
    levels = {name: margins.pop(name) for name in ("test_within", "unsafe_beyond")}
    asked = {name: planned[name] for name in ("cdbs_ma", "min_ma", "max_ma", "horizon_steps")} | {
        "snapshot_sha256": snapshot["sha256"],
        "policy_sha256": planned["policy"]["sha256"],
        "preset": params.preset,
        "seed": params.seed,
        "step_ma": STEPS_MA[params.device],
        "margins": margins,
        "levels": levels,
    }
    found = job.compute_all([(FIND_RULE, "find_rule", asked)])[0]
    if "failed" in found:
        raise Invalid(f"No rule was found: {found['failed']}.", "Check the participant's sessions and limits.")
    about = {name: planned[name] for name in ("policy", "cdbs_ma", "min_ma", "max_ma", "beta")}
    counted = {"snapshot_id": snapshot["id"], "sessions": snapshot["sessions"], "steps": snapshot["steps"]}
    return found | about | counted | {"hemisphere": params.hemisphere, "device": params.device}
