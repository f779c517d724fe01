"""Every query of visit plans. Visits and policies come already scoped to what the caller may see."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date

from sqlalchemy import distinct, exists, func, or_, select
from sqlalchemy.orm import Session, selectinload

from app.platform.database import now
from app.study.repository import CONFIRMED, count
from app.tables.adverse_events import AdverseEvent
from app.tables.data_queries import DataQuery
from app.tables.evaluations import Evaluation
from app.tables.participants import Hemisphere
from app.tables.plans import Plan, PlanItem
from app.tables.recordings import Recording
from app.tables.sessions import StudySession
from app.tables.visits import Dose, Visit, VisitLock


def live_plan(db: Session, visit_id: int) -> Plan | None:
    """Load the visit's plan that is not superseded, with its items."""
    return db.scalar(select(Plan).where(Plan.visit_id == visit_id, Plan.status != "superseded").options(selectinload(Plan.items)))


def plans(db: Session, participant_id: int, limit: int, offset: int) -> tuple[Sequence[tuple[Plan, Visit]], int]:
    """Load a page of a participant's plans with their visits, newest visit and newest plan first."""
    query = select(Plan, Visit).join(Visit, Visit.id == Plan.visit_id).where(Visit.participant_id == participant_id)
    rows = db.execute(
        query.order_by(Visit.number.desc(), Plan.id.desc()).limit(limit).offset(offset).options(selectinload(Plan.items))
    ).all()
    return [(row[0], row[1]) for row in rows], count(db, select(Plan.id).join(Visit).where(Visit.participant_id == participant_id))


def lock_visit(db: Session, visit_id: int) -> None:
    """Let one transaction at a time change the plan of a visit."""
    db.execute(select(Visit.id).where(Visit.id == visit_id).with_for_update())


def earlier_designed_visits(db: Session, visit: Visit) -> int:
    """Count visits of the participant before this one whose live plan has random sessions with sustained draws."""
    query = (
        select(func.count(distinct(Plan.visit_id)))
        .join(PlanItem, PlanItem.plan_id == Plan.id)
        .join(Visit, Visit.id == Plan.visit_id)
        .where(Visit.participant_id == visit.participant_id, Visit.number < visit.number, Plan.status != "superseded")
        .where(PlanItem.design["design"].astext.in_(("stratified", "ladder")))
    )
    return db.scalar(query) or 0


def session_count(db: Session, visit_id: int) -> int:
    """Count confirmed sessions that a visit already has."""
    return db.scalar(select(func.count()).select_from(StudySession).where(StudySession.visit_id == visit_id, CONFIRMED)) or 0


def has_sessions(db: Session, visit_id: int) -> bool:
    """Check whether a visit has sessions, proposed ones too."""
    return db.scalar(select(exists().where(StudySession.visit_id == visit_id))) or False


def open_visits(db: Session, participant_id: int, today: date) -> Sequence[Visit]:
    """List visits that may still be planned: without a confirmed session, today or later or without a date; by number."""
    return db.scalars(
        select(Visit)
        .where(Visit.participant_id == participant_id, or_(Visit.date.is_(None), Visit.date >= today))
        .where(~exists().where(StudySession.visit_id == Visit.id, CONFIRMED))
        .order_by(Visit.number)
    ).all()


def next_visit_number(db: Session, participant_id: int) -> int:
    """Return the number after the participant's last visit."""
    return (db.scalar(select(func.max(Visit.number)).where(Visit.participant_id == participant_id)) or 0) + 1


def recordings_newest_first(db: Session, participant_id: int, hemisphere: Hemisphere | None) -> Sequence[Recording]:
    """Load the participant's recordings; where a side is named, those of it and those that name none."""
    query = select(Recording).where(Recording.participant_id == participant_id)
    if hemisphere is not None:
        query = query.where((Recording.hemisphere == hemisphere) | Recording.hemisphere.is_(None))
    return db.scalars(query.order_by(Recording.started_at.desc().nulls_last(), Recording.id.desc())).all()


def earlier_planned_visits(db: Session, visit: Visit) -> int:
    """Count visits of the participant before this one whose live plan tests policies."""
    query = (
        select(func.count(distinct(Plan.visit_id)))
        .join(PlanItem, PlanItem.plan_id == Plan.id)
        .join(Visit, Visit.id == Plan.visit_id)
        .where(Visit.participant_id == visit.participant_id, Visit.number < visit.number, Plan.status != "superseded")
        .where(PlanItem.policy_id.is_not(None))
    )
    return db.scalar(query) or 0


def what_holds(db: Session, visit_id: int) -> list[str]:
    """List what keeps a visit from being removed, in words."""
    sessions = db.scalar(select(func.count()).select_from(StudySession).where(StudySession.visit_id == visit_id)) or 0
    signed = db.scalar(select(func.count()).select_from(Plan).where(Plan.visit_id == visit_id, Plan.approved_at.is_not(None))) or 0
    events = db.scalar(select(func.count()).select_from(AdverseEvent).where(AdverseEvent.visit_id == visit_id)) or 0
    locks = db.scalar(select(func.count()).select_from(VisitLock).where(VisitLock.visit_id == visit_id)) or 0
    doses = db.scalar(select(func.count()).select_from(Dose).where(Dose.visit_id == visit_id)) or 0
    counted = {"sessions or proposals": sessions, "a plan that was signed": signed, "adverse events": events, "locks": locks}
    counted["doses of medication"] = doses  # those that were taken back too: they stay, and show that something was done
    counted["data queries"] = db.scalar(select(func.count()).select_from(DataQuery).where(DataQuery.visit_id == visit_id)) or 0
    return [what for what, count in counted.items() if count]


def swap(db: Session, one: PlanItem, other: PlanItem) -> None:
    """Let two sessions of a plan change places; each place keeps its washout and its break."""
    places = (one.position, one.washout_minutes, one.break_minutes), (other.position, other.washout_minutes, other.break_minutes)
    one.position = -1
    db.flush()
    other.position, other.washout_minutes, other.break_minutes = places[0]
    db.flush()
    one.position, one.washout_minutes, one.break_minutes = places[1]
    db.flush()


def delete_visit(db: Session, visit: Visit) -> None:
    """Remove a visit with its plans; its cDBS amplitudes stay as removed ones."""
    for plan in db.scalars(select(Plan).where(Plan.visit_id == visit.id)):
        db.delete(plan)
    for amplitude in visit.cdbs_amplitudes:
        amplitude.removed_at = now()
    db.flush()
    db.expire(visit, ["cdbs_amplitudes"])
    db.delete(visit)


def evaluation(db: Session, evaluation_id: int) -> Evaluation:
    """Load an evaluation that a plan pins, with its estimates."""
    return db.get_one(Evaluation, evaluation_id, options=[selectinload(Evaluation.estimates)])


def pinned_evaluations(db: Session, participant_id: int) -> dict[int, int]:
    """Return by visit the evaluation whose predictions its signed plan rests on; plans without one are ignored."""
    query = select(Plan.visit_id, Plan.evaluation_id).join(Visit, Visit.id == Plan.visit_id)
    query = query.where(Visit.participant_id == participant_id, Plan.status == "approved", Plan.evaluation_id.is_not(None))
    return {visit_id: evaluation_id for visit_id, evaluation_id in db.execute(query) if evaluation_id is not None}
