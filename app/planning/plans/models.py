"""Tables of visit plans."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import CheckConstraint, ForeignKey, Index, String, Text, UniqueConstraint, func
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base
from app.study.models import Controller


class Plan(Base):
    """What shall happen at a visit: drafted from a ranking, approved by a clinician, then fixed."""

    __tablename__ = "plan"
    __table_args__ = (
        CheckConstraint("status in ('draft', 'approved', 'superseded')", name="status"),
        CheckConstraint("(status = 'draft') = (approved_at is null) or status = 'superseded'", name="approval"),
        Index("uq_plan_visit_live", "visit_id", unique=True, postgresql_where="status <> 'superseded'"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    visit_id: Mapped[int] = mapped_column(ForeignKey("visit.id"), index=True)
    evaluation_id: Mapped[int | None] = mapped_column(ForeignKey("evaluation.id"))
    status: Mapped[str] = mapped_column(String(20), server_default="draft")
    seed: Mapped[int]
    rules: Mapped[dict[str, Any]]
    note: Mapped[str] = mapped_column(Text, server_default="")
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    approved_at: Mapped[datetime | None]
    approved_by: Mapped[str | None] = mapped_column(String(254))
    items: Mapped[list[PlanItem]] = relationship(order_by="PlanItem.position", cascade="all, delete-orphan")


class PlanItem(Base):
    """One session of a plan."""

    __tablename__ = "plan_item"
    __table_args__ = (
        UniqueConstraint("plan_id", "position"),
        CheckConstraint("minutes > 0 and washout_minutes >= 0", name="minutes"),
        CheckConstraint("controller in ('cdbs', 'rl', 'distilled', 'no_dbs', 'random', 'other')", name="controller"),
        CheckConstraint("min_fraction > 0 and min_fraction <= 1", name="min_fraction"),
        CheckConstraint("override_reason is null or override_reason <> ''", name="override_reason"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    plan_id: Mapped[int] = mapped_column(ForeignKey("plan.id", ondelete="CASCADE"))
    position: Mapped[int]
    controller: Mapped[Controller] = mapped_column(String(20))
    policy_id: Mapped[int | None] = mapped_column(ForeignKey("policy.id"))
    minutes: Mapped[float]
    washout_minutes: Mapped[float]
    note: Mapped[str] = mapped_column(Text, server_default="")
    verdict: Mapped[str | None] = mapped_column(String(20))
    """What the ranking said of the policy when the plan was drafted."""
    min_fraction: Mapped[float | None]
    """Lowest amplitude of the session's envelope, fraction of the cDBS amplitude; None where the plan states none."""
    override_reason: Mapped[str | None] = mapped_column(Text)
    """Why a clinician plans an unsafe policy all the same."""
    design: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    """What a random session shall try, `app.planning.plans.designs.Planned.as_json`; null for other controllers and in plans of before."""
