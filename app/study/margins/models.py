"""Tables of margins and of their locks."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, ForeignKey, String, Text, UniqueConstraint, func
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base


class MarginsVersion(Base):
    """By how much an outcome may be worse than under cDBS, and how sure a proposal must be of it. Never changed, only followed.

    `grasp_share` is a share of the grasp frequency under cDBS, `rating_points` points of the rating, `tremor_points` percentage points of
    time with tremor. The levels: a policy is proposed for a test where it keeps all outcomes within the margins with probability
    `test_within` and saves energy with `test_saves`; it is unsafe where an outcome lies beyond its margin with `unsafe_beyond`, or where
    more than `nearly_off_share` of its steps are nearly off.
    """

    __tablename__ = "margins_version"
    __table_args__ = (
        UniqueConstraint("participant_id", "version"),
        CheckConstraint("grasp_share > 0 and grasp_share < 1 and rating_points > 0 and tremor_points > 0", name="margins"),
        CheckConstraint(
            "test_within > 0 and test_within < 1 and test_saves > 0 and test_saves < 1 and unsafe_beyond > 0 and unsafe_beyond < 1"
            " and nearly_off_share >= 0 and nearly_off_share < 1",
            name="levels",
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    version: Mapped[int]
    grasp_share: Mapped[float]
    rating_points: Mapped[float]
    tremor_points: Mapped[float]
    test_within: Mapped[float]
    test_saves: Mapped[float]
    unsafe_beyond: Mapped[float]
    nearly_off_share: Mapped[float]
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)


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
