"""Table of participants' characteristics."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import CheckConstraint, ForeignKey, String, Text, UniqueConstraint, func
from sqlalchemy.orm import Mapped, mapped_column

from app.platform.database import Base


class CharacteristicsVersion(Base):
    """Who the participant is, as far as the study needs it. Never changed, only followed by a newer version.

    `leads` has an object per lead: `hemisphere`, `target`, `model`, `sensing`, `stimulating` (contacts). `medication` has an object per
    dose of an ordinary visit day: `drug`, `mg`, `at` (local time of day, HH:MM).
    """

    __tablename__ = "characteristics_version"
    __table_args__ = (UniqueConstraint("participant_id", "version"), CheckConstraint("hand in ('left', 'right')", name="hand"))

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    version: Mapped[int]
    leads: Mapped[list[Any]] = mapped_column(server_default="[]")
    symptoms: Mapped[list[Any]] = mapped_column(server_default="[]")
    hand: Mapped[str | None] = mapped_column(String(5))
    """The hand that goes with the symptoms, whose grasp test counts; None where nobody stated it."""
    medication: Mapped[list[Any]] = mapped_column(server_default="[]")
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str] = mapped_column(Text)
