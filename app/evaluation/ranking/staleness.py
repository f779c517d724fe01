"""Whether a ranking still speaks about the study as it is, and what has changed since where it does not."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from app.evaluation.models import Evaluation
from app.learning import repository as learning
from app.learning.models import BufferSnapshot, SnapshotSession
from app.learning.snapshots.service import Collection, Member
from app.study import repository as study_repository
from app.study.models import Participant


def stale_reasons(db: Session, participant: Participant, evaluation: Evaluation, present: Collection | None) -> list[str]:
    """Why the ranking no longer speaks about the study as it is, in words; empty when it does."""
    reasons = []
    snapshot = learning.snapshot_members(db, evaluation.snapshot_id)
    if evaluation.settings_version_id != participant.current_settings.id:
        old = study_repository.settings_version(db, evaluation.settings_version_id).version
        reasons.append(f"settings version {participant.current_settings.version} is in force; this ranking used version {old}")
    row = db.get_one(BufferSnapshot, evaluation.snapshot_id)
    if present is not None and present.pins_sha256 != row.pins_sha256:
        changes = _changes(snapshot, present.members)
        if changes or not reasons:
            reasons += changes or ["the data of its sessions have changed since"]
    ranked = set(evaluation.diagnostics.get("candidates", []))
    missing = [p.name for p in learning.candidates(db, participant.id) if p.id not in ranked]
    if missing:
        listed = ", ".join(missing[:5]) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        reasons.append(f"{_count(len(missing), 'policy', 'policies')} not in it: {listed}")
    return reasons


def _changes(old: Sequence[SnapshotSession], new: Sequence[Member]) -> list[str]:
    """What happened to the sessions since a snapshot."""
    before = {m.session_id: m for m in old}
    inside = {m.session.id: m for m in new}
    both = [(before[i], inside[i]) for i in before.keys() & inside.keys()]
    added = [m for i, m in inside.items() if i not in before]
    found = {
        f"newer: {_visits(added)}": len(added),
        "no longer confirmed": len(before.keys() - inside.keys()),
        "with corrected QoCs": sum((n.session.qoc.id if n.session.qoc else None) != o.qoc_id for o, n in both),
        "newly left out": sum(n.left_out is not None and o.left_out_reason is None for o, n in both),
        "newly included": sum(n.left_out is None and o.left_out_reason is not None for o, n in both),
        "decoded anew": sum((n.table.beta_trace.id if n.table and n.table.beta_trace else None) != o.beta_trace_id for o, n in both),
        "with another cDBS amplitude": sum((n.table.cdbs_ma if n.table else None) != o.cdbs_amplitude_ma for o, n in both),
    }
    return [f"{_count(n, 'session', 'sessions')} {what}" for what, n in found.items() if n]


def _visits(members: Sequence[Member]) -> str:
    return "visit " + ", ".join(str(n) for n in sorted({m.session.visit.number for m in members}))


def _count(n: int, one: str, many: str) -> str:
    return f"{n} {one if n == 1 else many}"
