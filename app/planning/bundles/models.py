"""Tables of controller bundles."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import CheckConstraint, ForeignKey, String, func
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import Mapped, mapped_column

from app.platform.database import Base
from app.study.models import Hemisphere


class BundleRelease(Base):
    """A controller bundle that left the service: who took which policy within which limits, and with whose approval. Insert only.

    `policy_id` is null where the session's amplitudes were laid out beforehand, `plan_item_id` where the bundle is for no planned session.
    `approvals` holds the sign-offs that stood in the manifest; null for bundles taken before they were recorded here. `content_sha256` is
    of what the bundle holds but who took it first and when: who takes the same gets the same bytes; null for bundles of earlier versions.
    """

    __tablename__ = "bundle_release"
    __table_args__ = (
        CheckConstraint("hemisphere in ('left', 'right')", name="hemisphere"),
        CheckConstraint("policy_id is not null or plan_item_id is not null", name="what"),
        CheckConstraint("min_ma >= 0 and min_ma <= cdbs_ma and cdbs_ma <= max_ma and ramp_ma_per_s > 0", name="limits"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    policy_id: Mapped[int | None] = mapped_column(ForeignKey("policy.id"), index=True)
    plan_item_id: Mapped[int | None] = mapped_column(ForeignKey("plan_item.id"), index=True)
    sha256: Mapped[str] = mapped_column(ForeignKey("stored_file.sha256"))
    content_sha256: Mapped[str | None] = mapped_column(String(64), index=True)
    hemisphere: Mapped[Hemisphere | None] = mapped_column(String(10))
    min_ma: Mapped[float]
    max_ma: Mapped[float]
    cdbs_ma: Mapped[float]
    ramp_ma_per_s: Mapped[float]
    approvals: Mapped[list[dict[str, Any]] | None] = mapped_column(JSONB(none_as_null=True))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
