"""Tables of sessions beside the session itself: what it ran under."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import BigInteger, CheckConstraint, ForeignKey, String, Text, UniqueConstraint, func
from sqlalchemy.dialects.postgresql import INT4RANGE, TSTZRANGE, ExcludeConstraint, Range
from sqlalchemy.orm import Mapped, mapped_column

from app.platform.database import Base


class CountedTime(Base):
    """Which minutes of which device and side a confirmed session counts on; kept by triggers, so that none can count twice.

    `device_side` is the range [4 device, 4 device + 4) where no side is known, else one number of it, so that a recording of no side
    meets those of both; ranges need no extension of PostgreSQL. `span` leaves a second out at both ends: clocks are not exact.
    """

    __tablename__ = "counted_time"
    __table_args__ = (
        ExcludeConstraint(
            ("device_side", "&&"), ("span", "&&"), name="counted_time_once", using="gist", deferrable=True, initially="IMMEDIATE"
        ),
    )

    session_id: Mapped[int] = mapped_column(ForeignKey("session.id", ondelete="CASCADE"), primary_key=True)
    recording_id: Mapped[int] = mapped_column(ForeignKey("recording.id"), primary_key=True)
    start_s: Mapped[float] = mapped_column(primary_key=True)
    device_side: Mapped[Range[int]] = mapped_column(INT4RANGE)
    span: Mapped[Range[datetime]] = mapped_column(TSTZRANGE)


class Activity(StrEnum):
    """What a participant did in the half hour before a session."""

    REST = "rest"
    LIGHT = "light"
    EXERCISE = "exercise"
    MEAL = "meal"
    SLEEP = "sleep"


class SessionConditions(Base):
    """What a session ran under, as far as it is known; a correction is a new revision, and results pin the one they used.

    `origin`: `stated` by a person or a plan; `settings` in force by the clock when the session ran; `assumed` where neither tells.
    `design_parameters` has `level` and `holds` (objects of `start`, `steps`, `amplitude`, `log_density`) as `ml.designs` has them.
    `programming` has an object per program: `hemisphere`, `group`, `program`, `contacts`, `pulse_width_us`, `rate_hz`.
    """

    __tablename__ = "session_conditions"
    __table_args__ = (
        UniqueConstraint("session_id", "revision"),
        CheckConstraint("origin in ('stated', 'settings', 'assumed')", name="origin"),
        CheckConstraint("lower_bound >= 0 and lower_bound < 1", name="lower_bound"),
        CheckConstraint('"window" >= 1 and period_s > 0', name="window"),
        CheckConstraint("min_ma >= 0 and max_ma >= min_ma", name="limits"),
        CheckConstraint("lead_amplitude_ma >= 0 and cdbs_amplitude_ma > 0", name="amplitudes"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    session_id: Mapped[int] = mapped_column(ForeignKey("session.id", ondelete="CASCADE"), index=True)
    revision: Mapped[int]
    origin: Mapped[str] = mapped_column(String(10))
    lower_bound: Mapped[float]
    window: Mapped[int]
    period_s: Mapped[float]
    xi_beta: Mapped[float | None]
    min_ma: Mapped[float | None]
    max_ma: Mapped[float | None]
    seed: Mapped[int | None] = mapped_column(BigInteger)
    design: Mapped[str | None] = mapped_column(String(40))
    design_parameters: Mapped[dict[str, Any]] = mapped_column(server_default="{}")
    lead_amplitude_ma: Mapped[float | None]
    cdbs_amplitude_ma: Mapped[float | None]
    programming: Mapped[list[Any]] = mapped_column(server_default="[]")
    entered_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
