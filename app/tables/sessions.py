"""Tables of sessions: what drove them, which recordings they hold, what they ran under."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    ForeignKey,
    Index,
    SmallInteger,
    String,
    Text,
    UniqueConstraint,
    func,
)
from sqlalchemy.dialects.postgresql import INT4RANGE, TSTZRANGE, ExcludeConstraint, Range
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base
from app.tables.outcomes import QocRevision
from app.tables.participants import HEMISPHERE_CHECK, Hemisphere
from app.tables.recordings import TIME_CHECK, Recording
from app.tables.visits import Visit
from ml.designs import Bound


class Controller(StrEnum):
    """Kind of controller that drove the stimulation of a session."""

    CDBS = "cdbs"
    RL = "rl"
    DISTILLED = "distilled"
    NO_DBS = "no_dbs"
    RANDOM = "random"
    OTHER = "other"


LEARNED = (Controller.RL, Controller.DISTILLED)
"""Controllers that were learned from data."""


class Activity(StrEnum):
    """Activity of a participant in the half hour before a session."""

    REST = "rest"
    LIGHT = "light"
    EXERCISE = "exercise"
    MEAL = "meal"
    SLEEP = "sleep"


class StudySession(Base):
    """One controller at work for 5-20 minutes. Which one it was is asked of `app.study.blinding.arm` alone, hence the underscores.

    A proposed session is what an upload seems to hold: it counts nowhere until a person confirms it, and may have no controller yet.
    """

    __tablename__ = "session"
    __table_args__ = (
        UniqueConstraint("visit_id", "ordinal"),
        CheckConstraint("controller in ('cdbs', 'rl', 'distilled', 'no_dbs', 'random', 'other')", name="controller"),
        CheckConstraint("status in ('proposed', 'confirmed')", name="status"),
        CheckConstraint("status = 'proposed' or controller is not null", name="controller_stated"),
        CheckConstraint("duration_s >= 0", name="duration"),
        CheckConstraint("control_program between 0 and 15", name="control_program"),
        CheckConstraint(HEMISPHERE_CHECK, name="hemisphere"),
        CheckConstraint("excluded_reason is null or excluded_reason <> ''", name="excluded_reason"),
        CheckConstraint("stopped_reason is null or stopped_reason <> ''", name="stopped_reason"),
        CheckConstraint("medication_h >= 0 and medication_h <= 72", name="medication"),
        CheckConstraint("activity in ('rest', 'light', 'exercise', 'meal', 'sleep')", name="activity"),
        CheckConstraint(TIME_CHECK, name="started_at"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    visit_id: Mapped[int] = mapped_column(ForeignKey("visit.id"), index=True)
    ordinal: Mapped[int]
    _controller: Mapped[Controller | None] = mapped_column("controller", String(20))
    _policy_id: Mapped[int | None] = mapped_column("policy_id", ForeignKey("policy.id"), index=True)
    hemisphere: Mapped[Hemisphere | None] = mapped_column(String(5))
    status: Mapped[str] = mapped_column(String(20), server_default="confirmed")
    started_at: Mapped[datetime | None]
    duration_s: Mapped[float]
    plan_item_id: Mapped[int | None] = mapped_column(ForeignKey("plan_item.id"), unique=True)
    """The slot of the visit's plan that this session fills; None for an unplanned session."""
    control_stream: Mapped[str] = mapped_column(String(40), server_default="beta")
    control_channel: Mapped[str | None] = mapped_column(String(80))
    control_program: Mapped[int | None] = mapped_column(SmallInteger)
    """Whose amplitude the controller set; null: the first of the control recording's programs, which mostly has one."""
    excluded_reason: Mapped[str | None] = mapped_column(Text)
    stopped_reason: Mapped[str | None] = mapped_column(Text)
    """Why it was stopped for the patient's sake: a failure of its controller, never a missing value. None where it was not."""
    medication_h: Mapped[float | None]
    """Hours from the last dose to the start, as a person stated them; what counts says `app.study.doses`."""
    activity: Mapped[Activity | None] = mapped_column(String(10))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    visit: Mapped[Visit] = relationship(back_populates="sessions")
    segments: Mapped[list[SessionSegment]] = relationship(
        back_populates="session", order_by="SessionSegment.start_s", cascade="all, delete-orphan", passive_deletes=True
    )
    qocs: Mapped[list[QocRevision]] = relationship(back_populates="session", order_by="QocRevision.revision")
    conditions_revisions: Mapped[list[SessionConditions]] = relationship(order_by="SessionConditions.revision")

    if TYPE_CHECKING:  # mapped in `app.tables.plans`
        letter: Mapped[str | None]
        """What its blinded plan calls it; None outside of blinded plans."""

    @property
    def qoc(self) -> QocRevision | None:
        """The newest revision of the session's QoCs."""
        return self.qocs[-1] if self.qocs else None

    @property
    def conditions(self) -> SessionConditions | None:
        """The newest conditions of the session; None for a proposal, whose conditions are recorded when it is confirmed."""
        return self.conditions_revisions[-1] if self.conditions_revisions else None


class SessionSegment(Base):
    """The part of a recording that belongs to a session, in seconds of the recording's clock."""

    __tablename__ = "session_segment"
    __table_args__ = (CheckConstraint("stop_s > start_s", name="order"), Index("ix_session_segment_recording", "recording_id"))

    session_id: Mapped[int] = mapped_column(ForeignKey("session.id", ondelete="CASCADE"), primary_key=True)
    recording_id: Mapped[int] = mapped_column(ForeignKey("recording.id"), primary_key=True)
    start_s: Mapped[float] = mapped_column(primary_key=True)
    stop_s: Mapped[float]
    is_control: Mapped[bool] = mapped_column(server_default="true")
    session: Mapped[StudySession] = relationship(back_populates="segments")
    recording: Mapped[Recording] = relationship()


class CountedTime(Base):
    """Time span of a device and side that a confirmed session uses. Triggers maintain it, so that no minute counts twice.

    `device_side` is the range [4 device, 4 device + 4) if the side is unknown, else one number of that range. A recording of unknown side
    thus overlaps those of both sides; ranges need no extension of PostgreSQL. `span` omits a second at both ends: clocks are not exact.
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


class SessionConditions(Base):
    """Known conditions of a session. A correction is a new revision; results pin the one they used.

    `origin`: `stated` by a person or a plan; `settings` in force by the clock when the session ran; `assumed` if neither is known.
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

    @property
    def bound(self) -> Bound:
        """Lower bound B of random sessions."""
        return Bound(self.lower_bound)
