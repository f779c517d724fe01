"""Tables of the study. A recording is not a session: recordings belong to a device and a clock, `SessionSegment` links the two."""

from __future__ import annotations

from datetime import date, datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa
from sqlalchemy import CheckConstraint, ForeignKey, Index, LargeBinary, SmallInteger, String, Text, UniqueConstraint, func, text
from sqlalchemy.orm import Mapped, column_property, mapped_column, relationship

from app.accounts.models import Site
from app.platform.database import ONE_STANDING, Base
from app.study.characteristics.models import CharacteristicsVersion
from app.study.doses.models import Dose
from app.study.margins.models import MarginsLock, MarginsVersion
from app.study.outcome_fields import HasOutcomes, add_value_columns, value_checks
from app.study.sessions.models import Activity, SessionConditions


class Controller(StrEnum):
    """What drove the stimulation of a session."""

    CDBS = "cdbs"
    RL = "rl"
    DISTILLED = "distilled"
    NO_DBS = "no_dbs"
    RANDOM = "random"
    OTHER = "other"


class Hemisphere(StrEnum):
    """Side of the brain."""

    LEFT = "left"
    RIGHT = "right"

    @property
    def opposite(self) -> Hemisphere:
        """The other side, whose hand this one moves."""
        return Hemisphere.RIGHT if self is Hemisphere.LEFT else Hemisphere.LEFT


TIME_CHECK = "started_at >= '1990-01-01Z' and started_at < '2201-01-01Z'"
HEMISPHERE_CHECK = "hemisphere in ('left', 'right')"
_AMPLITUDES = "and_(CdbsAmplitude.visit_id == Visit.id, CdbsAmplitude.removed_at.is_(None))"
_DOSES = "and_(Dose.visit_id == Visit.id, Dose.removed_at.is_(None))"


class Participant(Base):
    """A person in the study, known by code only."""

    __tablename__ = "participant"
    __table_args__ = (
        CheckConstraint("status in ('active', 'completed', 'withdrawn')", name="status"),
        Index("uq_participant_code_lower", func.lower(text("code")), unique=True),  # T4 and t4 would be mixed up at the bedside
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    site_id: Mapped[int] = mapped_column(ForeignKey("site.id"), index=True)
    code: Mapped[str] = mapped_column(String(40), unique=True)
    status: Mapped[str] = mapped_column(String(20), server_default="active")
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    site: Mapped[Site] = relationship()
    settings: Mapped[list[SettingsVersion]] = relationship(back_populates="participant", order_by="SettingsVersion.version")
    margins: Mapped[list[MarginsVersion]] = relationship(order_by=MarginsVersion.version)
    margins_locks: Mapped[list[MarginsLock]] = relationship(order_by=MarginsLock.id)
    visits: Mapped[list[Visit]] = relationship(back_populates="participant", order_by="Visit.number")
    characteristics: Mapped[list[CharacteristicsVersion]] = relationship(order_by=CharacteristicsVersion.version)

    @property
    def current_characteristics(self) -> CharacteristicsVersion | None:
        """The newest characteristics; None where nobody stated any."""
        return self.characteristics[-1] if self.characteristics else None

    @property
    def current_margins(self) -> MarginsVersion:
        """The newest margins and levels; a participant always has some."""
        return self.margins[-1]

    @property
    def margins_in_force(self) -> MarginsVersion:
        """The margins that verdicts go by, of rankings and analyses alike: those of the newest lock, else the newest."""
        return self.margins_lock.margins if self.margins_lock else self.current_margins

    @property
    def margins_lock(self) -> MarginsLock | None:
        """The lock in force, which is the newest; None where nobody locked any margins."""
        return self.margins_locks[-1] if self.margins_locks else None

    @property
    def current_settings(self) -> SettingsVersion:
        """The newest settings version; a participant always has one."""
        return self.settings[-1]


class SettingsVersion(Base):
    """MDP and signal settings of a participant. Never changed, only followed by a newer version."""

    __tablename__ = "settings_version"
    __table_args__ = (
        UniqueConstraint("participant_id", "version"),
        CheckConstraint("c1 >= 0 and c2 >= 0 and c3 >= 0 and c4 >= 0", name="weights"),
        CheckConstraint('"window" >= 1 and period_s > 0', name="window"),
        CheckConstraint("gamma >= 0 and gamma < 1", name="gamma"),
        CheckConstraint("lower_bound >= 0 and lower_bound < 1", name="lower_bound"),
        CheckConstraint("r_a >= r_b", name="rewards"),
        CheckConstraint("cdbs_amplitude_ma > 0", name="cdbs_amplitude"),
        CheckConstraint("beta_low_hz > 0 and beta_low_hz < beta_high_hz", name="beta_band"),
        CheckConstraint("min_valid_fraction > 0 and min_valid_fraction <= 1", name="min_valid"),
        CheckConstraint("most_imputed >= 0", name="most_imputed"),
        CheckConstraint("beta_measure in ('rms', 'power')", name="beta_measure"),
        CheckConstraint("design in ('stratified', 'paper')", name="design"),
        CheckConstraint("early_visits >= 1", name="early_visits"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    version: Mapped[int]
    xi_beta: Mapped[float | None]
    beta_unit: Mapped[str | None] = mapped_column(String(40))
    beta_source: Mapped[str | None] = mapped_column(String(40))
    window: Mapped[int]
    period_s: Mapped[float]
    r_a: Mapped[float]
    r_b: Mapped[float]
    c1: Mapped[float]
    c2: Mapped[float]
    c3: Mapped[float]
    c4: Mapped[float]
    gamma: Mapped[float]
    lower_bound: Mapped[float]
    tremor_as_fraction: Mapped[bool]
    cdbs_amplitude_ma: Mapped[float | None]
    beta_low_hz: Mapped[float]
    beta_high_hz: Mapped[float]
    min_valid_fraction: Mapped[float]
    most_imputed: Mapped[int] = mapped_column(SmallInteger, server_default="0")
    beta_measure: Mapped[str] = mapped_column(String(10), server_default="rms")
    design: Mapped[str] = mapped_column(String(20), server_default="paper")
    design_ladder: Mapped[bool] = mapped_column(server_default="false")
    early_visits: Mapped[int] = mapped_column(SmallInteger, server_default="3")
    pool_programmings: Mapped[bool] = mapped_column(server_default="false")
    pool_shapes: Mapped[bool] = mapped_column(server_default="false")
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)
    participant: Mapped[Participant] = relationship(back_populates="settings")


class CdbsAmplitude(Base):
    """The clinician's cDBS amplitude in force at a visit, per hemisphere and program, whence fractions. A removed one counts no more."""

    __tablename__ = "cdbs_amplitude"
    __table_args__ = (
        Index("uq_cdbs_amplitude_visit_id_hemisphere_program", "visit_id", "hemisphere", "program", **ONE_STANDING),
        CheckConstraint("visit_id is not null or removed_at is not null", name="belongs"),
        CheckConstraint("amplitude_ma > 0", name="amplitude"),
        CheckConstraint("program between 0 and 3", name="program"),
        CheckConstraint(HEMISPHERE_CHECK, name="hemisphere"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    visit_id: Mapped[int | None] = mapped_column(ForeignKey("visit.id", ondelete="SET NULL"), index=True)
    hemisphere: Mapped[Hemisphere] = mapped_column(String(5))
    program: Mapped[int] = mapped_column(SmallInteger)
    amplitude_ma: Mapped[float]
    removed_at: Mapped[datetime | None]


class Device(Base):
    """An implant or another source of recordings, under a keyed pseudonym."""

    __tablename__ = "device"
    __table_args__ = (UniqueConstraint("participant_id", "pseudonym"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    pseudonym: Mapped[str] = mapped_column(String(64))
    kind: Mapped[str] = mapped_column(String(40))


class Visit(Base):
    """A day in the clinic."""

    __tablename__ = "visit"
    __table_args__ = (UniqueConstraint("participant_id", "number"), CheckConstraint("number >= 1", name="number"))

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    number: Mapped[int]
    date: Mapped[date | None]
    note: Mapped[str] = mapped_column(Text, server_default="")
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    participant: Mapped[Participant] = relationship(back_populates="visits")
    sessions: Mapped[list[StudySession]] = relationship(back_populates="visit", order_by="StudySession.ordinal")
    cdbs_amplitudes: Mapped[list[CdbsAmplitude]] = relationship(lazy="selectin", primaryjoin=_AMPLITUDES)
    doses: Mapped[list[Dose]] = relationship(lazy="selectin", order_by=(Dose.taken_at, Dose.id), primaryjoin=_DOSES)
    locks: Mapped[list[VisitLock]] = relationship(back_populates="visit", order_by="VisitLock.id", lazy="selectin")
    if TYPE_CHECKING:  # mapped below, where the class that they belong to is there
        sealed: Mapped[bool]
        """Whether the key of its signed plan is sealed, so that nobody may know what ran (`app.study.blinding`)."""
        unsealed_at: Mapped[datetime | None]
        """When the key of its signed plan was opened; None where it is sealed or the plan is not blinded."""

    @property
    def locked(self) -> bool:
        """Whether the visit's data are closed for changes, and open to blinded assessors."""
        return bool(self.locks) and self.locks[-1].locked


_PLANS = sa.table("plan", *(sa.column(name) for name in ("visit_id", "status", "blinded", "key_opened_at")))
_BLINDED = (_PLANS.c.visit_id == Visit.id, _PLANS.c.status == "approved", _PLANS.c.blinded)
# plans belong to a later phase, and of their table only the key is needed here; a column of the visit costs a list of visits no query
Visit.sealed = column_property(sa.exists().where(*_BLINDED, _PLANS.c.key_opened_at.is_(None)).correlate(Visit.__table__))
_OPENED = sa.select(func.max(_PLANS.c.key_opened_at)).where(*_BLINDED)
Visit.unsealed_at = column_property(_OPENED.correlate(Visit.__table__).scalar_subquery())


class VisitLock(Base):
    """A visit was locked or unlocked, by whom, when and why. Rows are only added; the newest one holds."""

    __tablename__ = "visit_lock"
    __table_args__ = (CheckConstraint("reason <> ''", name="reason"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    visit_id: Mapped[int] = mapped_column(ForeignKey("visit.id"), index=True)
    locked: Mapped[bool]
    reason: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    settings_version_id: Mapped[int | None] = mapped_column(ForeignKey("settings_version.id"))
    """The participant's settings when the visit was locked, by which it goes while it stays locked; None of an unlock."""
    visit: Mapped[Visit] = relationship(back_populates="locks")


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
    """The slot of the visit's plan that this session fills; None of a session that nobody planned."""
    control_stream: Mapped[str] = mapped_column(String(40), server_default="beta")
    control_channel: Mapped[str | None] = mapped_column(String(80))
    control_program: Mapped[int | None] = mapped_column(SmallInteger)
    """Whose amplitude the controller set; null: the first of the control recording's programs, which mostly has one."""
    excluded_reason: Mapped[str | None] = mapped_column(Text)
    stopped_reason: Mapped[str | None] = mapped_column(Text)
    """Why it was stopped for the patient's sake: a failure of its controller, never a missing value. None where it was not."""
    medication_h: Mapped[float | None]
    """Hours from the last dose to the start, as a person stated them; what counts says `app.study.doses.since`."""
    activity: Mapped[Activity | None] = mapped_column(String(10))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    visit: Mapped[Visit] = relationship(back_populates="sessions")
    segments: Mapped[list[SessionSegment]] = relationship(
        back_populates="session", order_by="SessionSegment.start_s", cascade="all, delete-orphan", passive_deletes=True
    )
    qocs: Mapped[list[QocRevision]] = relationship(back_populates="session", order_by="QocRevision.revision")
    conditions_revisions: Mapped[list[SessionConditions]] = relationship(order_by="SessionConditions.revision")

    if TYPE_CHECKING:
        letter: Mapped[str | None]
        """What its blinded plan calls it; None outside of blinded plans."""

    @property
    def qoc(self) -> QocRevision | None:
        """The newest revision of the session's QoCs."""
        return self.qocs[-1] if self.qocs else None

    @property
    def conditions(self) -> SessionConditions | None:
        """What the session ran under, newest revision; None of a proposal, whose conditions are taken down when it is confirmed."""
        return self.conditions_revisions[-1] if self.conditions_revisions else None


_ITEMS = sa.table("plan_item", sa.column("id"), sa.column("label"))
_LETTER = sa.select(_ITEMS.c.label).where(_ITEMS.c.id == StudySession.plan_item_id)
StudySession.letter = column_property(_LETTER.correlate(StudySession.__table__).scalar_subquery())


class Recording(Base):
    """A stretch of data of one device under one clock; may span a whole visit and hold several sessions."""

    __tablename__ = "recording"
    __table_args__ = (
        UniqueConstraint("participant_id", "fingerprint"),
        CheckConstraint(HEMISPHERE_CHECK, name="hemisphere"),
        CheckConstraint("clock in ('device', 'pc', 'table')", name="clock"),
        CheckConstraint(TIME_CHECK, name="started_at"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    device_id: Mapped[int] = mapped_column(ForeignKey("device.id"), index=True)
    upload_file_id: Mapped[int | None] = mapped_column(ForeignKey("upload_file.id"), index=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    hemisphere: Mapped[Hemisphere | None] = mapped_column(String(5))
    clock: Mapped[str] = mapped_column(String(10))
    started_at: Mapped[datetime | None]
    duration_s: Mapped[float]
    details: Mapped[dict[str, Any]]
    superseded_by_id: Mapped[int | None] = mapped_column(ForeignKey("recording.id"), index=True)
    """The fuller copy of the same minutes that sessions use instead."""
    device: Mapped[Device] = relationship()
    traces: Mapped[list[Trace]] = relationship(back_populates="recording", order_by="Trace.stream")


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


class Trace(Base):
    """A 2 s trace of a recording: beta amplitude, amplitude in mA, band power. Row i ends at `first_end_s + i dt_s`.

    `values_f32` is little-endian float32, `valid_bits` numpy.packbits of the valid mask; both have `n` entries.
    """

    __tablename__ = "trace"
    __table_args__ = (
        UniqueConstraint("recording_id", "decode_version", "stream", "channel"),
        CheckConstraint("n >= 0 and dt_s > 0 and octet_length(values_f32) = 4 * n", name="length"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    recording_id: Mapped[int] = mapped_column(ForeignKey("recording.id", ondelete="CASCADE"))
    decode_version: Mapped[int]
    stream: Mapped[str] = mapped_column(String(40))
    channel: Mapped[str] = mapped_column(String(80), server_default="")
    unit: Mapped[str] = mapped_column(String(40))
    source: Mapped[str] = mapped_column(String(40))
    dt_s: Mapped[float]
    first_end_s: Mapped[float]
    n: Mapped[int]
    values_f32: Mapped[bytes] = mapped_column(LargeBinary)
    valid_bits: Mapped[bytes] = mapped_column(LargeBinary)
    details: Mapped[dict[str, Any]] = mapped_column(server_default="{}")
    recording: Mapped[Recording] = relationship(back_populates="traces")


class QocRevision(HasOutcomes, Base):
    """End-of-session QoCs of a session, a column per outcome; a correction is a new revision."""

    __tablename__ = "qoc"
    __table_args__ = (
        UniqueConstraint("session_id", "revision"),
        *value_checks(),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    session_id: Mapped[int] = mapped_column(ForeignKey("session.id", ondelete="CASCADE"), index=True)
    revision: Mapped[int]
    entered_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)
    derived: Mapped[list[Any]] = mapped_column(server_default="[]")
    """Names of the QoCs that stand in this revision as they were derived from uploaded files, not as a person typed them."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    session: Mapped[StudySession] = relationship(back_populates="qocs")


add_value_columns(QocRevision)
