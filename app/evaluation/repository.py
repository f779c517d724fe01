"""Every query of evaluations."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, and_, func, or_, select, text
from sqlalchemy.orm import Session, defer

from app.tables.audit import AuditEvent
from app.tables.evaluations import EstimateRow, Evaluation
from app.tables.learning import Policy
from app.tables.participants import Participant

Rows = list[dict[str, Any]]


def newest_evaluation(db: Session, participant_id: int) -> Evaluation | None:
    """Load the participant's last evaluation; its estimates, with all their draws, are read on first use."""
    return db.scalar(select(Evaluation).where(Evaluation.participant_id == participant_id).order_by(Evaluation.id.desc()).limit(1))


def diagnostics_of_others(db: Session, participant: Participant, member: str) -> dict[int, dict[str, Any]]:
    """Return one member of the diagnostics of the newest evaluation of every other participant of the site who has not withdrawn, by its
    number.

    Evaluations without that member are ignored.
    """
    newest = (
        select(func.max(Evaluation.id))
        .join(Participant, Participant.id == Evaluation.participant_id)
        .where(Participant.site_id == participant.site_id, Participant.id != participant.id, Participant.status != "withdrawn")
        .group_by(Evaluation.participant_id)
    )
    query = select(Evaluation.id, Evaluation.diagnostics[member].label("said")).where(Evaluation.id.in_(newest)).order_by(Evaluation.id)
    return {row.id: row.said for row in db.execute(query) if row.said}


def lock_job(db: Session, job_id: str) -> None:
    """Let one call at a time store the evaluation of a job; the lock lasts to the end of the transaction."""
    db.execute(text("select pg_advisory_xact_lock(hashtextextended(:key, 0))"), {"key": f"evaluation:{job_id}"})


def evaluation_of_job(db: Session, job_id: str, *, first_answer: bool = False) -> Evaluation | None:
    """Find what a job evaluated in the end, or as its first answer."""
    return db.scalar(select(Evaluation).where(Evaluation.job_id == job_id, Evaluation.first_answer.is_(first_answer)))


def evaluation(db: Session, participant_id: int, evaluation_id: int) -> Evaluation | None:
    """Find a participant's evaluation by its number."""
    return db.scalar(select(Evaluation).where(Evaluation.participant_id == participant_id, Evaluation.id == evaluation_id))


def evaluation_times(db: Session, participant_id: int) -> dict[int, datetime]:
    """Return when each of the participant's evaluations was stored, by its number."""
    query = select(Evaluation.id, Evaluation.created_at).where(Evaluation.participant_id == participant_id)
    return {row.id: row.created_at for row in db.execute(query.order_by(Evaluation.id))}


def policies_by_id(db: Session, ids: Sequence[int]) -> dict[int, Policy]:
    """Load policies by their number; their curves and other metrics are read on first use."""
    query = select(Policy).where(Policy.id.in_(ids)).options(defer(Policy.metrics))
    return {p.id: p for p in db.scalars(query)}


def methods(db: Session, evaluation_id: int) -> set[str]:
    """List methods that an evaluation has estimates of."""
    return set(db.scalars(select(EstimateRow.method).where(EstimateRow.evaluation_id == evaluation_id).distinct()))


class PolicyHead(NamedTuple):
    """Facts of a policy that a ranking shows and judges it by, as values: two equal heads are judged equally.

    `amplitude` is that of a constant, fraction of cDBS; None for every other policy.
    """

    id: int
    name: str
    kind: str
    algorithm: str
    teacher_id: int | None
    retired_reason: str | None
    amplitude: float | None

    @property
    def is_cdbs(self) -> bool:
        """True for the reference with the constant cDBS amplitude."""
        return self.kind == "baseline" and self.algorithm == "constant" and self.amplitude == 1.0


def head_of(policy: Policy) -> PolicyHead:
    """Build the head of a loaded policy."""
    held = _amplitude(policy.config.get("amplitude"))
    return PolicyHead(policy.id, policy.name, policy.kind, policy.algorithm, policy.teacher_id, policy.retired_reason, held)


def policy_heads(db: Session, evaluation_id: int) -> dict[int, PolicyHead]:
    """Load the present head of every policy that an evaluation estimated, by its number."""
    estimated = select(EstimateRow.policy_id).where(EstimateRow.evaluation_id == evaluation_id)
    columns = (Policy.id, Policy.name, Policy.kind, Policy.algorithm, Policy.teacher_id, Policy.retired_reason)
    query = select(*columns, Policy.config["amplitude"].label("held")).where(Policy.id.in_(estimated)).order_by(Policy.id)
    return {
        row.id: PolicyHead(row.id, row.name, row.kind, row.algorithm, row.teacher_id, row.retired_reason, _amplitude(row.held))
        for row in db.execute(query)
    }


def _amplitude(stored: Any) -> float | None:
    return float(stored) if isinstance(stored, int | float) else None


def changed_since(db: Session, moment: datetime, wanted: Mapping[str, tuple[str, Collection[int]]]) -> dict[str, tuple[Rows, Rows]]:
    """Load rows at a moment and at present, of those that the audit trail has a change of since, by table.

    Changes are chained from row to row, not by key, because a key may change too. What was changed back is on both sides.

    Args:
        wanted: by table, a column, and the values of it that are looked for.
    """

    def mine(entity: str, column: str, ids: Collection[int]) -> ColumnElement[bool]:
        either = or_(AuditEvent.before[column].as_integer().in_(ids), AuditEvent.after[column].as_integer().in_(ids))
        return and_(AuditEvent.entity == entity, either)

    found: dict[str, tuple[Rows, Rows]] = {entity: ([], []) for entity in wanted}
    matches = or_(*(mine(entity, column, ids) for entity, (column, ids) in wanted.items()))
    for event in db.scalars(select(AuditEvent).where(AuditEvent.at > moment, matches).order_by(AuditEvent.id)):
        then, now = found[event.entity]
        if event.before is not None and event.before in now:
            now.remove(event.before)
        elif event.before is not None:
            then.append(event.before)
        if event.after is not None:
            now.append(event.after)
    return found
