"""Queries of controller bundles: who took them, the device's recordings, and the plans that approve a policy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime

from sqlalchemy import Row, column, select, table
from sqlalchemy.orm import Session

from app.platform.audit import AuditEvent
from app.study.models import Hemisphere, Recording, Visit


def stored_file_events(db: Session, reason: str) -> Sequence[AuditEvent]:
    """Events of stored files whose reason begins so, newest first."""
    named = AuditEvent.reason.startswith(reason, autoescape=True)
    return db.scalars(select(AuditEvent).where(AuditEvent.entity == "stored_file", named).order_by(AuditEvent.id.desc())).all()


def newest_recordings(db: Session, participant_id: int, hemisphere: Hemisphere | None) -> Iterable[Recording]:
    """A participant's recordings, of this side or of none where one is named, newest first."""
    query = select(Recording).where(Recording.participant_id == participant_id)
    if hemisphere is not None:
        query = query.where((Recording.hemisphere == hemisphere) | Recording.hemisphere.is_(None))
    return db.scalars(query.order_by(Recording.started_at.desc().nulls_last(), Recording.id.desc()))


def approved_plans(db: Session, policy_id: int) -> Iterable[Row[int, str, datetime, int]]:
    """Number, approver, time of approval and visit of the approved plans that a policy stands in.

    The tables of plans are asked by name: plans and bundles do not know each other.
    """
    plan = table("plan", *(column(name) for name in ("id", "visit_id", "status", "approved_at", "approved_by")))
    item = table("plan_item", column("plan_id"), column("policy_id"))
    return db.execute(
        select(plan.c.id, plan.c.approved_by, plan.c.approved_at, Visit.number)
        .join_from(plan, Visit, Visit.id == plan.c.visit_id)
        .where(plan.c.status == "approved", plan.c.id.in_(select(item.c.plan_id).where(item.c.policy_id == policy_id)))
        .order_by(plan.c.id)
    )
