"""Tables of participants and what is stated of them in versions: settings, characteristics, margins."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from sqlalchemy import (
    CheckConstraint,
    Double,
    ForeignKey,
    Index,
    SmallInteger,
    String,
    Text,
    UniqueConstraint,
    func,
    text,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base, column_info
from app.tables.accounts import Site
from ml.designs import Bound
from ml.outcomes import BUILT_IN, OUTCOMES

if TYPE_CHECKING:
    from app.tables.visits import Visit


class Hemisphere(StrEnum):
    """Side of the brain."""

    LEFT = "left"
    RIGHT = "right"

    @property
    def opposite(self) -> Hemisphere:
        """The other side, whose hand this one moves."""
        return Hemisphere.RIGHT if self is Hemisphere.LEFT else Hemisphere.LEFT


HEMISPHERE_CHECK = "hemisphere in ('left', 'right')"


class CharacteristicsVersion(Base):
    """Characteristics of the participant that the study needs. Never changed, only followed by a newer version.

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
    """The hand of the symptoms, whose test counts at the end of a session; None where not stated."""
    medication: Mapped[list[Any]] = mapped_column(server_default="[]")
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str] = mapped_column(Text)


def margin_check() -> CheckConstraint:
    """Return the constraint that every margin is above 0, and a share below 1."""
    shares = {o.margin.field for o in OUTCOMES if o.margin.kind == "share"}
    bounds = (f"{o.margin.field} > 0" + (f" and {o.margin.field} < 1" if o.margin.field in shares else "") for o in OUTCOMES)
    return CheckConstraint(" and ".join(bounds), name="margins")


def add_margin_columns(table: type[Base]) -> None:
    """Add a column per margin to a table."""
    for o in OUTCOMES:
        m = o.margin
        check = f"{m.field} > 0" + (f" and {m.field} < 1" if m.kind == "share" else "")
        definition = None if o in BUILT_IN else {"check": check, "kind": m.kind, "unit": m.unit}
        default = None if definition is None else str(m.default)  # of versions that were stated before the outcome was
        setattr(table, m.field, mapped_column(Double, nullable=False, server_default=default, info=column_info(definition)))


class MarginsVersion(Base):
    """By how much an outcome may be worse than under cDBS, and how sure a proposal must be of it. Never changed, only followed.

    One column per margin of `ml.outcomes`. A policy is proposed for a test if it keeps all outcomes within the margins with probability
    `test_within` and saves energy with probability `test_saves`. It is unsafe if an outcome is beyond twice its margin with probability
    `unsafe_beyond`, or if more than `nearly_off_share` of its steps are nearly off.
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


class DeclaredConfirmation(Base):
    """A policy whose later sessions all confirm, by the margins locked then, whatever is planned. Signed once, never changed."""

    __tablename__ = "declared_confirmation"
    __table_args__ = (CheckConstraint("reason <> ''", name="reason"), UniqueConstraint("policy_id"))

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    policy_id: Mapped[int] = mapped_column(ForeignKey("policy.id"))
    margins_lock_id: Mapped[int] = mapped_column(ForeignKey("margins_lock.id"))
    reason: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(server_default=func.clock_timestamp())
    created_by: Mapped[str] = mapped_column(String(254))
    lock: Mapped[MarginsLock] = relationship(lazy="joined")


class Participant(Base):
    """A person in the study, known by code only, or a simulation of one."""

    __tablename__ = "participant"
    __table_args__ = (
        CheckConstraint("status in ('active', 'completed', 'withdrawn')", name="status"),
        Index("uq_participant_code_lower", func.lower(text("code")), unique=True),  # T4 and t4 would be mixed up at the bedside
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    site_id: Mapped[int] = mapped_column(ForeignKey("site.id"), index=True)
    code: Mapped[str] = mapped_column(String(40), unique=True)
    status: Mapped[str] = mapped_column(String(20), server_default="active")
    synthetic: Mapped[bool] = mapped_column(server_default="false")
    """Whether this is a simulation and no person; fixed at enrolment."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    site: Mapped[Site] = relationship()
    settings: Mapped[list[SettingsVersion]] = relationship(back_populates="participant", order_by="SettingsVersion.version")
    margins: Mapped[list[MarginsVersion]] = relationship(order_by=MarginsVersion.version)
    margins_locks: Mapped[list[MarginsLock]] = relationship(order_by=MarginsLock.id)
    visits: Mapped[list[Visit]] = relationship(back_populates="participant", order_by="Visit.number")
    characteristics: Mapped[list[CharacteristicsVersion]] = relationship(order_by=CharacteristicsVersion.version)

    @property
    def current_characteristics(self) -> CharacteristicsVersion | None:
        """The newest characteristics; None if none were stated."""
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
        """The lock in force, which is the newest; None if no margins were locked."""
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

    @property
    def bound(self) -> Bound:
        """Lower bound B of random sessions."""
        return Bound(self.lower_bound)
