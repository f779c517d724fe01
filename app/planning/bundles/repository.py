"""Every query of controller bundles. Participants and policies come from callers that have checked the caller's scope."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import or_, select, text
from sqlalchemy.orm import Session, selectinload

from app.tables.learning import Policy
from app.tables.plans import SEALED, BundleRelease, Plan, PlanItem, PortCheck
from app.tables.visits import Visit


def releases(db: Session, policy_id: int) -> Sequence[BundleRelease]:
    """List the released bundles of a policy, newest first; without those of sealed plans (`plans.key`), whose time reveals what ran."""
    sealed = select(PlanItem.id).join(Plan, Plan.id == PlanItem.plan_id).where(SEALED)
    told = or_(BundleRelease.plan_item_id.is_(None), BundleRelease.plan_item_id.not_in(sealed))
    return db.scalars(select(BundleRelease).where(BundleRelease.policy_id == policy_id, told).order_by(BundleRelease.id.desc())).all()


def releases_of_slots(db: Session, item_ids: Sequence[int]) -> Sequence[BundleRelease]:
    """List bundles that left for sessions of plans, newest first."""
    return db.scalars(select(BundleRelease).where(BundleRelease.plan_item_id.in_(item_ids)).order_by(BundleRelease.id.desc())).all()


def port_checks(db: Session, policy_ids: Sequence[int]) -> Sequence[PortCheck]:
    """List the checks of ports of some policies, newest first."""
    return db.scalars(select(PortCheck).where(PortCheck.policy_id.in_(policy_ids)).order_by(PortCheck.id.desc())).all()


def lock_content(db: Session, content_sha256: str) -> None:
    """Let one transaction at a time take a content for the first time."""
    db.execute(text("select pg_advisory_xact_lock(hashtextextended(:key, 0))"), {"key": f"bundle:{content_sha256}"})


def kept(db: Session, participant_id: int, content_sha256: str) -> str | None:
    """Find the newest file of a participant's bundle by the SHA-256 of its content; None where it was never taken."""
    mine = (BundleRelease.participant_id == participant_id) & (BundleRelease.content_sha256 == content_sha256)
    return db.scalar(select(BundleRelease.sha256).where(mine).order_by(BundleRelease.id.desc()).limit(1))


def withdrawn_policies(db: Session) -> Sequence[int]:
    """List policies of this installation that were retired."""
    return db.scalars(select(Policy.id).where(Policy.retired_reason.is_not(None)).order_by(Policy.id)).all()


def withdrawn_plans(db: Session) -> Sequence[int]:
    """List plans of this installation that were signed and then replaced."""
    return db.scalars(select(Plan.id).where(Plan.status == "superseded", Plan.approved_at.is_not(None)).order_by(Plan.id)).all()


def signed_plans(db: Session, participant_id: int) -> Sequence[Plan]:
    """Load the participant's approved visit plans with their items."""
    query = select(Plan).join(Visit, Visit.id == Plan.visit_id).where(Visit.participant_id == participant_id, Plan.status == "approved")
    return db.scalars(query.order_by(Plan.id).options(selectinload(Plan.items))).all()


def planned_limits(db: Session, participant_id: int, policy_id: int) -> Sequence[float]:
    """List lowest amplitudes, fractions of cDBS, that the participant's approved plans state for a policy, newest plan first."""
    found = db.scalars(
        select(PlanItem.min_fraction)
        .join(Plan, Plan.id == PlanItem.plan_id)
        .join(Visit, Visit.id == Plan.visit_id)
        .where(Visit.participant_id == participant_id, Plan.status == "approved", PlanItem.policy_id == policy_id)
        .order_by(Plan.id.desc())
    )
    return [limit for limit in found if limit is not None]


def approved_plans(db: Session, participant_id: int, policy_id: int) -> Sequence[tuple[Plan, int]]:
    """List the participant's approved visit plans with a policy, each with its visit's number."""
    rows = db.execute(
        select(Plan, Visit.number)
        .join(Visit, Visit.id == Plan.visit_id)
        .where(Visit.participant_id == participant_id, Plan.status == "approved")
        .where(Plan.id.in_(select(PlanItem.plan_id).where(PlanItem.policy_id == policy_id)))
        .order_by(Plan.id)
    )
    return [(plan, number) for plan, number in rows]
