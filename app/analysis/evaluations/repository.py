"""Queries of evaluations by seed."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from app.tables.evaluations import EstimateRow, Evaluation
from app.tables.learning import SnapshotSession


def evaluations(db: Session, participant_id: int) -> Sequence[Evaluation]:
    """A participant's evaluations with their estimates less the details of these, oldest first."""
    query = select(Evaluation).where(Evaluation.participant_id == participant_id).order_by(Evaluation.id)
    wanted = selectinload(Evaluation.estimates).load_only(EstimateRow.policy_id, EstimateRow.method, EstimateRow.value)
    return db.scalars(query.options(wanted)).all()


def sessions_of_snapshot(db: Session, snapshot_id: int) -> set[int]:
    """Sessions that a snapshot rests on, left-out ones included: their outcomes were there to be seen."""
    return set(db.scalars(select(SnapshotSession.session_id).where(SnapshotSession.snapshot_id == snapshot_id)))
