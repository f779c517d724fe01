"""Tables of margins and of their locks."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, ForeignKey, String, Text, UniqueConstraint, func
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base
from app.study.outcome_fields import add_margin_columns, margin_check


class MarginsVersion(Base):
    """By how much an outcome may be worse than under cDBS, and how sure a proposal must be of it. Never changed, only followed.

    A column per margin of `ml.outcomes`. The levels: a policy is proposed for a test where it keeps all outcomes within the margins with
    probability `test_within` and saves energy with `test_saves`; it is unsafe where an outcome lies beyond its margin with
    `unsafe_beyond`, or where more than `nearly_off_share` of its steps are nearly off.
    """

    __tablename__ = "margins_version"
    __table_args__ = (
        UniqueConstraint("participant_id", "version"),
        margin_check(),
        CheckConstraint(
            "test_within > 0 and test_within < 1 and test_saves > 0 and test_saves < 1 and unsafe_beyond > 0 and unsafe_beyond < 1"
            " and nearly_off_share >= 0 and nearly_off_share < 1",
            name="levels",
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    version: Mapped[int]
    test_within: Mapped[float]
    test_saves: Mapped[float]
    unsafe_beyond: Mapped[float]
    nearly_off_share: Mapped[float]
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)


add_margin_columns(MarginsVersion)


class MarginsLock(Base):
    """Margins were fixed before the sessions that they judge: what is recorded later confirms, what was recorded before explores.

    Rows are only added; the newest one holds.
    """

    __tablename__ = "margins_lock"
    __table_args__ = (CheckConstraint("reason <> ''", name="reason"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    margins_version_id: Mapped[int] = mapped_column(ForeignKey("margins_version.id"))
    reason: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    margins: Mapped[MarginsVersion] = relationship()
