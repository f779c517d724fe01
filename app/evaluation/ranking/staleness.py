"""Whether a ranking still speaks about the study as it is, and what has changed since where it does not, as typed flags."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from app.evaluation.models import Evaluation
from app.learning import repository as learning
from app.learning.models import BufferSnapshot, SnapshotSession
from app.learning.snapshots.service import Collection, Member
from app.study import repository as study_repository
from app.study.models import Participant
from ml.ope.flags import Flag

NAMED = 5
"""Policies that are named where a ranking lacks some."""


def stale_reasons(db: Session, participant: Participant, evaluation: Evaluation, present: Collection | None) -> list[Flag]:
    """Why the ranking no longer speaks about the study as it is; empty when it does."""
    reasons: list[Flag] = []
    snapshot = learning.snapshot_members(db, evaluation.snapshot_id)
    if evaluation.settings_version_id != participant.current_settings.id:
        old = study_repository.settings_version(db, evaluation.settings_version_id).version
        reasons.append(Flag("settings_changed", float(participant.current_settings.version), float(old)))
    row = db.get_one(BufferSnapshot, evaluation.snapshot_id)
    if present is not None and present.pins_sha256 != row.pins_sha256:
        changes = _changes(snapshot, present.members)
        if changes or not reasons:
            reasons += changes or [Flag("data_changed")]
    ranked = set(evaluation.diagnostics.get("candidates", []))
    missing = [p.name for p in learning.candidates(db, participant.id) if p.id not in ranked]
    if missing:
        reasons.append(Flag.of("policies_missing", float(len(missing)), None, "policies", names=tuple(missing[:NAMED])))
    return reasons


def _changes(old: Sequence[SnapshotSession], new: Sequence[Member]) -> list[Flag]:
    """What happened to the sessions since a snapshot."""
    before = {m.session_id: m for m in old}
    inside = {m.session.id: m for m in new}
    both = [(before[i], inside[i]) for i in before.keys() & inside.keys()]
    added = [m for i, m in inside.items() if i not in before]
    found = {
        "newer": len(added),
        "unconfirmed": len(before.keys() - inside.keys()),
        "qoc": sum((n.session.qoc.id if n.session.qoc else None) != o.qoc_id for o, n in both),
        "left_out": sum(n.left_out is not None and o.left_out_reason is None for o, n in both),
        "included": sum(n.left_out is None and o.left_out_reason is not None for o, n in both),
        "decoded": sum((n.table.beta_trace.id if n.table and n.table.beta_trace else None) != o.beta_trace_id for o, n in both),
        "cdbs": sum((n.table.cdbs_ma if n.table else None) != o.cdbs_amplitude_ma for o, n in both),
    }
    visits = tuple(str(n) for n in sorted({m.session.visit.number for m in added}))
    return [Flag.of("sessions_changed", float(n), None, "sessions", change=change, visits=visits) for change, n in found.items() if n]
