"""Table of what was entered on the clinic day."""

from __future__ import annotations

import uuid
from datetime import datetime
from typing import Any

from sqlalchemy import BigInteger, CheckConstraint, ForeignKey, SmallInteger, String, Uuid, func
from sqlalchemy.orm import Mapped, mapped_column

from app.platform.database import Base

KINDS = (
    "start", "stop", "stop_cause", "rating", "grasp", "dyskinesia", "speech", "gait", "note", "adverse_event", "skip", "repeat",
    "session_end", "clinical_settings", "dose",
)  # fmt: skip
OF_THE_DAY = ("note", "adverse_event", "clinical_settings", "dose")
"""Kinds that may belong to the day as a whole; all others belong to one session of the plan."""


class DayEntry(Base):
    """One thing that somebody entered on the clinic day. Insert only; a correction is a new entry that names what it replaces.

    `device_time` is as the tablet's clock had it, `clock_offset_ms` what must be added to it to have the service's time, as last measured
    by the tablet; null where the tablet had not reached the service yet.
    """

    __tablename__ = "day_entry"
    __table_args__ = (
        CheckConstraint(f"kind in ({', '.join(repr(k) for k in KINDS)})", name="kind"),
        CheckConstraint("(plan_item_id is null) = (attempt is null) and attempt >= 1", name="attempt"),
        CheckConstraint(f"plan_item_id is not null or kind in ({', '.join(repr(k) for k in OF_THE_DAY)})", name="session"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    uuid: Mapped[uuid.UUID] = mapped_column(Uuid, unique=True)
    plan_id: Mapped[int] = mapped_column(ForeignKey("plan.id"), index=True)
    plan_item_id: Mapped[int | None] = mapped_column(ForeignKey("plan_item.id"), index=True)
    attempt: Mapped[int | None] = mapped_column(SmallInteger)
    kind: Mapped[str] = mapped_column(String(20))
    payload: Mapped[dict[str, Any]]
    replaces: Mapped[list[Any]] = mapped_column(server_default="[]")
    """Identifiers of the entries that this one corrects or decides between."""
    device_time: Mapped[datetime]
    clock_offset_ms: Mapped[int | None] = mapped_column(BigInteger)
    received_at: Mapped[datetime] = mapped_column(server_default=func.now())
    entered_by: Mapped[str] = mapped_column(String(254))
