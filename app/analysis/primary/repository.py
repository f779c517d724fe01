"""Queries of the primary analyses: names of policies, and when each was last picked for a visit."""

from __future__ import annotations

from collections.abc import Collection
from datetime import datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.tables.learning import Policy
from app.tables.plans import Plan, PlanItem


def policy_names(db: Session, participant_ids: Collection[int]) -> dict[int, dict[int, str]]:
    """Names of the participants' policies: by participant, then by policy."""
    found: dict[int, dict[int, str]] = {i: {} for i in participant_ids}
    for mine, policy, name in db.execute(select(Policy.participant_id, Policy.id, Policy.name).where(Policy.participant_id.in_(found))):
        found[mine][policy] = name
    return found


def last_picked(db: Session, participant_ids: Collection[int]) -> dict[int, dict[int, datetime]]:
    """When each policy was last put on a plan that was approved, by participant: what was known then may have picked it."""
    found: dict[int, dict[int, datetime]] = {i: {} for i in participant_ids}
    rows = db.execute(
        select(Policy.participant_id, PlanItem.policy_id, func.max(Plan.created_at))
        .join(Plan, Plan.id == PlanItem.plan_id)
        .join(Policy, Policy.id == PlanItem.policy_id)
        .where(Policy.participant_id.in_(found), Plan.approved_at.is_not(None))
        .group_by(Policy.participant_id, PlanItem.policy_id)
    )
    for mine, policy, moment in rows:
        if policy is not None:
            found[mine][policy] = moment
    return found
