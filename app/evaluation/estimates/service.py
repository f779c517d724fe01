"""Rules of evaluations: which policies are ranked, how estimates are stored and read again. The caller commits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy.orm import Session

from app.evaluation import repository
from app.evaluation.estimates import coverage as checks
from app.evaluation.estimates import dose_shapes, held_out
from app.evaluation.estimates.held_out import combined, widened
from app.evaluation.schemas import EvaluateParams
from app.learning import repository as learning
from app.learning.policies import onnx_of, require_window, window_of
from app.platform.errors import Invalid
from app.platform.jobs import service as jobs
from app.study import repository as study_repository
from app.tables.evaluations import EstimateRow, Evaluation
from app.tables.learning import BufferSnapshot, Policy
from app.tables.participants import Participant
from ml.ope import AGGREGATE, POSTERIOR, Estimate, default_method, shown

# Rules of evaluations: which policies are ranked, how estimates are stored. The caller commits.


def policies_to_rank(db: Session, participant_id: int, params: EvaluateParams, *, least: int = 1) -> list[Policy]:
    """Choose the candidates of an evaluation.

    Args:
        least: 0 where references alone are an answer too.

    Raises:
        NotFound: no such policy. Invalid: there is none, or a retired one or one of another window is named, or a stored file is missing.
    """
    window = db.get_one(Participant, participant_id).current_settings.window
    if not params.policies:
        found = list(learning.candidates(db, participant_id))
        if not found and least:
            raise Invalid(
                learning.no_candidate(db, participant_id),
                "Take a retired one back, train policies, or upload one made elsewhere as an ONNX file.",
            )
        fitting = [p for p in found if window_of(p) == window]
        if not fitting and least:
            raise Invalid(
                f"None of the {len(found)} policies takes windows of {window} beta amplitudes, as the settings say now.",
                "Train policies with these settings, or set the window back.",
            )
        for policy in fitting:
            onnx_of(policy)
        return fitting
    chosen = learning.policies_named(db, participant_id, params.policies)
    for policy in chosen:
        onnx_of(policy)
        require_window(policy, window)
        if policy.retired_reason:
            raise Invalid(f"Policy '{policy.name}' was retired: {policy.retired_reason}.", "Leave it out, or take it back first.")
    return [p for p in chosen if p.kind != "baseline"]


def store_evaluation(
    db: Session,
    *,
    job_id: str | None,
    created_by: str,
    snapshot: BufferSnapshot,
    horizon_steps: int,
    candidates: Sequence[int],
    results: Mapping[str, Mapping[str, Any]],
    config: Mapping[str, Any],
    skill: Mapping[str, Any] | None = None,
    coverage: Mapping[str, Any] | None = None,
    first_answer: bool = False,
) -> Evaluation:
    """Store every method's estimates of every policy; a job that has stored its evaluation gets that one.

    The ranking follows the posterior. Where that failed, it follows the first method of the usual order that supports a candidate, and then
    no candidate is proposed.

    Args:
        db: the session. job_id: the job. created_by: who asked for it.
        snapshot: what all estimates rest on. horizon_steps: H.
        candidates: ids of the policies that are ranked; the others are references.
        results: by method `{"estimates": {policy id: Estimate.to_json()}}`, of the posterior with `dose_shapes`, or `{"failed": reason}`.
        config: how the methods ran; where its `methods` name the combination, that is computed here from the others.
        skill: results of `choose_method` on held-out controllers: they widen the intervals of the single methods.
        coverage: what `check_coverage` found out; a policy that it refuses is not supported by the data, whatever a method says of it.
        first_answer: whether it is the job's first answer, which its own evaluation follows.

    Raises:
        Invalid: no method could speak; lists why.
    """
    if job_id is not None:
        # the job's row is locked by the call that stores for it; this covers direct calls too
        repository.lock_job(db, job_id)
        known = repository.evaluation_of_job(db, job_id, first_answer=first_answer)
        if known is not None:
            return known
    estimates: dict[str, dict[str, Estimate]] = {
        m: {i: Estimate.from_json(e) for i, e in r["estimates"].items()} for m, r in results.items() if r.get("estimates")
    }
    failed = {m: str(r["failed"]) for m, r in results.items() if "failed" in r}
    if AGGREGATE in config.get("methods", []):
        made = combined(estimates, skill)
        if "failed" in made:
            failed[AGGREGATE] = made["failed"]
        else:
            estimates[AGGREGATE] = made["estimates"]
    estimates = checks.refused(widened(estimates, skill), coverage)
    if not estimates:
        reasons = "; ".join(f"{shown(m).name}: {reason}" for m, reason in failed.items())
        raise Invalid(f"No method could estimate these policies: {reasons}.", "Collect more sessions, then evaluate again.")
    ranked = {m: {i: e for i, e in table.items() if int(i) in set(candidates)} for m, table in estimates.items()}
    able = {m: table for m, table in ranked.items() if table} if candidates else estimates
    row = Evaluation(
        participant_id=snapshot.participant_id,
        snapshot_id=snapshot.id,
        settings_version_id=snapshot.settings_version_id,
        job_id=job_id,
        first_answer=first_answer,
        horizon_steps=horizon_steps,
        gamma=study_repository.settings_version(db, snapshot.settings_version_id).gamma,
        default_method=POSTERIOR if POSTERIOR in able else default_method(able),
        config=dict(config),
        diagnostics={
            "failed": failed,
            "candidates": list(candidates),
            held_out.STORED: held_out.stored(skill, able),
            checks.STORED: dict(coverage or {}),
            dose_shapes.STORED: dict(results.get(POSTERIOR, {}).get(dose_shapes.STORED, {})),
        },
        code_version=jobs.code_version(),
        created_by=created_by,
    )
    row.estimates = [row_of(int(policy_id), e) for table in estimates.values() for policy_id, e in table.items()]
    db.add(row)
    db.flush()
    return row


# Estimates between the science's own type and their stored rows. A row has columns for what queries need; the rest is in `details`.

_COLUMNS = {column.key for column in EstimateRow.__table__.columns}


def row_of(policy_id: int, estimate: Estimate) -> EstimateRow:
    """Convert an estimate to its stored row."""
    stored = estimate.to_json()
    details = stored.pop("details") | {name: stored.pop(name) for name in list(stored) if name not in _COLUMNS}
    # an interval of a skewed bootstrap may miss the estimate itself; the table keeps it inside
    ends = {"low": min(estimate.low, estimate.value), "high": max(estimate.high, estimate.value)}
    predicted = {name: v for name, v in estimate.predicted.items() if v is not None}
    return EstimateRow(policy_id=policy_id, **stored | ends | {"predicted": predicted, "details": details})


def estimate_of(row: EstimateRow) -> Estimate:
    """Read a stored estimate of any version."""
    details = dict(row.details)
    apart = {name: details.pop(name) for name in ("step_return", "end_reward", "n", "version") if name in details}
    stored = {name: getattr(row, name) for name in _COLUMNS} | apart | {"details": details}
    return Estimate.from_json(stored | {"standard_error": row.standard_error or 0.0})
