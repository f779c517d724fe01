"""Queries of slots and the sessions that fill them. Visits come already scoped to what the caller may see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date

from sqlalchemy import false, func, or_, select
from sqlalchemy.orm import Session

from app.tables.plans import Plan, PlanItem
from app.tables.sessions import StudySession
from app.tables.visits import Visit, VisitLock


def sessions_of_day(db: Session, visit_id: int) -> Sequence[StudySession]:
    """Load sessions of a visit, proposed ones too, in the order in which they ran; those without a start by their place in the visit."""
    query = select(StudySession).where(StudySession.visit_id == visit_id)
    return db.scalars(query.order_by(StudySession.started_at.nulls_last(), StudySession.ordinal)).all()


@dataclass(frozen=True)
class Filled:
    """Count of slots of a visit's approved plan that confirmed sessions fill.

    `tested`: of those that run a policy. `locked`: whether the visit is. `sealed`: whether the plan's key is.
    """

    participant_id: int
    visit_id: int
    number: int
    date: date | None
    slots: int
    filled: int
    tested: int
    locked: bool
    sealed: bool


def slots_filled(db: Session, participant_ids: Sequence[int]) -> list[Filled]:
    """Count slots of every visit whose approved plan has limits in mA, by participant and visit number; older plans have none.

    Slots of a plan that was signed before count where a confirmed session fills them.
    """
    confirmed = StudySession.status == "confirmed"
    filled = func.count(StudySession.id).filter(confirmed)
    tested = func.count(StudySession.id).filter(confirmed & PlanItem.policy_id.is_not(None))
    newest = select(VisitLock.locked).where(VisitLock.visit_id == Visit.id).order_by(VisitLock.id.desc()).limit(1)
    locked = func.coalesce(newest.correlate(Visit).scalar_subquery(), false())
    query = (
        select(Visit.participant_id, Visit.id, Visit.number, Visit.date, func.count(PlanItem.id), filled, tested, locked, Visit.sealed)
        .join(Plan, Plan.visit_id == Visit.id)
        .join(PlanItem, PlanItem.plan_id == Plan.id)
        .outerjoin(StudySession, StudySession.plan_item_id == PlanItem.id)
        .where(Visit.participant_id.in_(participant_ids), PlanItem.max_ma.is_not(None))
        .where(Visit.id.in_(select(Plan.visit_id).where(Plan.status == "approved")))
        .where(or_(Plan.status == "approved", Plan.approved_at.is_not(None) & confirmed))
        .group_by(Visit.participant_id, Visit.id, Visit.number, Visit.date)
        .order_by(Visit.participant_id, Visit.number)
    )
    return [Filled(*row) for row in db.execute(query)]
