"""Every query of the clinic day. Plans come already scoped to what the caller may see."""

from __future__ import annotations

import uuid
from collections.abc import Collection, Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.planning.visit_day.record import SlotTimes, times_of
from app.study.repository import count
from app.tables.plans import DayEntry, Plan, PlanItem
from app.tables.sessions import StudySession


def entries(db: Session, plan_id: int) -> Sequence[DayEntry]:
    """Load all entries of a plan's day, in the order in which they arrived."""
    return db.scalars(select(DayEntry).where(DayEntry.plan_id == plan_id).order_by(DayEntry.id)).all()


def entries_of_visit(db: Session, visit_id: int, limit: int, offset: int) -> tuple[Sequence[DayEntry], int]:
    """Load a page of all entries about a visit, under whichever of its plans, in the order in which they arrived."""
    of_visit = select(DayEntry).join(Plan, Plan.id == DayEntry.plan_id).where(Plan.visit_id == visit_id)
    return db.scalars(of_visit.order_by(DayEntry.id).limit(limit).offset(offset)).all(), count(db, of_visit)


def entries_beside(db: Session, plan_item_id: int) -> Sequence[DayEntry]:
    """Load all entries of the day that a session of a plan belongs to, in the order in which they arrived."""
    of_item = select(PlanItem.plan_id).where(PlanItem.id == plan_item_id).scalar_subquery()
    return db.scalars(select(DayEntry).where(DayEntry.plan_id == of_item).order_by(DayEntry.id)).all()


def entries_named(db: Session, uuids: Collection[uuid.UUID]) -> dict[uuid.UUID, DayEntry]:
    """Load those of the named entries that are stored, of whatever plan."""
    return {row.uuid: row for row in db.scalars(select(DayEntry).where(DayEntry.uuid.in_(list(uuids))))}


def plan_of_visit(db: Session, visit_id: int, plan_id: int) -> Plan | None:
    """Find a plan of a visit that was approved once; it may have been replaced since."""
    return db.scalar(select(Plan).where(Plan.id == plan_id, Plan.visit_id == visit_id, Plan.approved_at.is_not(None)))


def lock_plan(db: Session, plan_id: int) -> None:
    """Let one transaction at a time add entries to a plan's day."""
    db.execute(select(Plan.id).where(Plan.id == plan_id).with_for_update())


def sessions_in_place(db: Session, plan_id: int) -> Sequence[StudySession]:
    """Return the confirmed sessions that fill places of a plan."""
    of_plan = select(PlanItem.id).where(PlanItem.plan_id == plan_id)
    query = select(StudySession).where(StudySession.plan_item_id.in_(of_plan), StudySession.status == "confirmed")
    return db.scalars(query.order_by(StudySession.id)).all()


def slot_times(db: Session, plan_id: int) -> dict[int, SlotTimes]:
    """Return when each session of a plan ran, by its id in the plan; without sessions of which nothing was entered."""
    return times_of(entries(db, plan_id))
