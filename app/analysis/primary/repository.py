"""Queries of the primary analyses: names of policies, and when each was last picked for a visit."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.learning.models import Policy
from app.planning.plans.models import Plan, PlanItem


def policy_names(db: Session, participant_id: int) -> dict[int, str]:
    """Names of a participant's policies."""
    rows = db.execute(select(Policy.id, Policy.name).where(Policy.participant_id == participant_id))
    return {row[0]: row[1] for row in rows}


def last_picked(db: Session, participant_id: int) -> dict[int, datetime]:
    """When each policy of a participant was last put on a plan that was approved: what was known then may have picked it."""
    rows = db.execute(
        select(PlanItem.policy_id, func.max(Plan.created_at))
        .join(Plan, Plan.id == PlanItem.plan_id)
        .join(Policy, Policy.id == PlanItem.policy_id)
        .where(Policy.participant_id == participant_id, Plan.approved_at.is_not(None))
        .group_by(PlanItem.policy_id)
    )
    return {row[0]: row[1] for row in rows if row[0] is not None}
