"""Policies, snapshots, sweeps and the gate as API types."""

from __future__ import annotations

from typing import Any

from sqlalchemy.orm import Session

from app.learning import wording
from app.learning.gate import service as gates
from app.learning.schemas import (
    BaselineScoreOut,
    GateDecisionOut,
    GateOut,
    PolicyOut,
    QocTestOut,
    SnapshotOut,
    SnapshotSessionOut,
    SweepCandidateOut,
    SweepOut,
)
from app.learning.sweeps import comparison
from app.study import repository as study_repository
from app.tables.learning import BufferSnapshot, Policy, Sweep
from app.tables.participants import Participant


def policy_out(db: Session, p: Policy, participant: Participant) -> PolicyOut:
    """Convert a policy for the API."""
    return PolicyOut(
        id=p.id,
        participant=participant.code,
        name=p.name,
        kind=p.kind,
        algorithm=p.algorithm,
        teacher_id=p.teacher_id,
        parent_id=p.parent_id,
        snapshot_id=p.snapshot_id,
        settings_version=study_repository.settings_version(db, p.settings_version_id).version,
        job_id=p.job_id,
        config=p.config,
        seed=p.seed,
        metrics=p.metrics,
        onnx_sha256=p.onnx_sha256,
        code_version=p.code_version,
        created_at=p.created_at,
        created_by=p.created_by,
        retired_reason=p.retired_reason,
    )


def snapshot_out(db: Session, s: BufferSnapshot, participant: Participant) -> SnapshotOut:
    """Convert a snapshot for the API."""
    return SnapshotOut(
        id=s.id,
        participant=participant.code,
        settings_version=study_repository.settings_version(db, s.settings_version_id).version,
        characteristics_version=next((c.version for c in participant.characteristics if c.id == s.characteristics_id), None),
        pins_sha256=s.pins_sha256,
        file_sha256=s.file_sha256,
        sessions=s.sessions,
        steps=s.steps,
        median_steps=s.median_steps,
        beta_unit=s.beta_unit,
        beta_source=s.beta_source,
        created_at=s.created_at,
        created_by=s.created_by,
        members=[SnapshotSessionOut.model_validate(m, from_attributes=True) for m in s.members],
    )


def gate_out(found: gates.Gate) -> GateOut:
    """Convert the gate for the API."""
    decision = found.decision
    return GateOut(
        open=found.is_open,
        grounds=wording.gate_grounds(found),
        opened_by_test=found.opened_by_test,
        tests=[
            QocTestOut(
                qoc=t.field,
                note=wording.gate_test_note(t),
                **{name: getattr(t, name) for name in QocTestOut.model_fields if name not in ("qoc", "note")},
            )
            for t in found.tests
        ],
        decision=None
        if decision is None
        else GateDecisionOut(
            choice=decision.choice, reason=decision.reason, created_at=decision.created_at, created_by=decision.created_by
        ),
    )


def _baseline(row: dict[str, Any]) -> BaselineScoreOut:
    gain = row.get("gain_over_cdbs") or {}
    return BaselineScoreOut(
        controller=row["controller"],
        score=row["score"],
        mean_amplitude=row["mean_amplitude"],
        gain_over_cdbs=gain.get("value"),
        gain_low=gain.get("low"),
    )


def sweep_out(db: Session, sweep: Sweep) -> SweepOut:
    """Convert a sweep for the API."""
    return SweepOut(
        id=sweep.id,
        participant=db.get_one(Participant, sweep.participant_id).code,
        name=sweep.name,
        snapshot_id=sweep.snapshot_id,
        job_id=sweep.job_id,
        config=sweep.config,
        held_out_sessions=sweep.baselines["held_out_sessions"],
        candidates=[
            SweepCandidateOut(
                policy_id=c.policy.id,
                name=c.policy.name,
                algorithm=c.policy.algorithm,
                actor_lr=c.rate,
                seed=c.seed,
                best_update=c.best_update,
                score=c.score,
                over_logged=c.over_logged,
                action_distance=c.action_distance,
                saturated=c.saturated,
                mean_amplitude=c.mean_amplitude,
                gain_over_cdbs=c.gain.value if c.gain else None,
                gain_low=c.gain.low if c.gain else None,
                gain_method=None if c.gain is None else "posterior" if c.by_posterior else "fqe",
                supported=c.supported if c.by_posterior else None,
                beyond_margin=c.beyond,
                within_margins=c.within,
                energy_saved=c.saves,
                below_bound=c.below[1] if c.below else None,
            )
            for c in comparison.candidates(sweep)
        ],
        baselines=[_baseline(row) for row in sweep.baselines["rows"]],
        code_version=sweep.code_version,
        created_at=sweep.created_at,
        created_by=sweep.created_by,
    )
