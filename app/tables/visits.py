"""Tables of visits: their locks, the clinical amplitude and the doses of medication."""

from __future__ import annotations

from datetime import date, datetime
from enum import StrEnum
from typing import TYPE_CHECKING

from sqlalchemy import (
    CheckConstraint,
    ForeignKey,
    Index,
    SmallInteger,
    String,
    Text,
    UniqueConstraint,
    func,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import ONE_STANDING, Base
from app.tables.participants import HEMISPHERE_CHECK, Hemisphere, Participant

if TYPE_CHECKING:
    from app.tables.sessions import StudySession


class Drug(StrEnum):
    """Drug of a dose."""

    LEVODOPA = "levodopa"
    LEVODOPA_CR = "levodopa_cr"
    LEVODOPA_COMT = "levodopa_comt"
    LEVODOPA_EQUIVALENT = "levodopa_equivalent"
    APOMORPHINE = "apomorphine"
    PRAMIPEXOLE = "pramipexole"
    ROPINIROLE = "ropinirole"
    ROTIGOTINE = "rotigotine"
    SELEGILINE = "selegiline"
    RASAGILINE = "rasagiline"
    SAFINAMIDE = "safinamide"
    AMANTADINE = "amantadine"
    ANTICHOLINERGIC = "anticholinergic"
    MUSCLE_RELAXANT = "muscle_relaxant"
    OTHER = "other"


class Dose(Base):
    """One dose that bears on a visit, taken in the clinic or before it. A wrong one is marked as
    removed, for a reason that the audit trail keeps, and counts no more."""

    __tablename__ = "dose"
    __table_args__ = (
        Index("uq_dose_visit_id_drug_taken_at", "visit_id", "drug", "taken_at", **ONE_STANDING),
        CheckConstraint(f"drug in ({', '.join(repr(d.value) for d in Drug)})", name="drug"),
        CheckConstraint("mg > 0 and mg <= 5000", name="mg"),
        CheckConstraint("taken_at >= '1990-01-01Z' and taken_at < '2201-01-01Z'", name="taken_at"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    visit_id: Mapped[int] = mapped_column(ForeignKey("visit.id"), index=True)
    drug: Mapped[Drug] = mapped_column(String(30))
    mg: Mapped[float]
    taken_at: Mapped[datetime]
    entered_by: Mapped[str] = mapped_column(String(254))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    removed_at: Mapped[datetime | None]


_AMPLITUDES = "and_(CdbsAmplitude.visit_id == Visit.id, CdbsAmplitude.removed_at.is_(None))"

_DOSES = "and_(Dose.visit_id == Visit.id, Dose.removed_at.is_(None))"


class CdbsAmplitude(Base):
    """Clinician's cDBS amplitude in force at a visit, per hemisphere and program (split among programs). Removed rows are ignored."""

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
    if TYPE_CHECKING:  # mapped in `app.tables.plans`
        sealed: Mapped[bool]
        """True while the key of its signed plan is sealed: what ran must stay unknown (`app.study.blinding`)."""
        unsealed_at: Mapped[datetime | None]
        """When the key of its signed plan was opened; None where it is sealed or the plan is not blinded."""

    @property
    def locked(self) -> bool:
        """True if the visit's data are closed for changes, and open to blinded assessors."""
        return bool(self.locks) and self.locks[-1].locked


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
