"""Tables of adverse events: what an event belongs to, and what is known of it, revision by revision."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum

from sqlalchemy import (
    CheckConstraint,
    ForeignKey,
    String,
    Text,
    UniqueConstraint,
    func,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base
from app.tables.participants import Participant
from app.tables.sessions import StudySession
from app.tables.visits import Visit


class EventKind(StrEnum):
    """What happened, as far as stimulation is known to do it; anything else is `other` with a note."""

    DYSKINESIA = "dyskinesia"
    SPEECH = "speech"
    GAIT = "gait"
    FALL = "fall"
    MUSCLE_CONTRACTION = "muscle_contraction"
    PARAESTHESIA = "paraesthesia"
    VISION = "vision"
    MOOD = "mood"
    COGNITION = "cognition"
    PAIN = "pain"
    NAUSEA = "nausea"
    DEVICE = "device"
    OTHER = "other"


class Severity(StrEnum):
    """How bad it was; `none` states that somebody looked and found nothing."""

    NONE = "none"
    MILD = "mild"
    SEVERE = "severe"


class AdverseEvent(Base):
    """Something that happened to a participant: in a session, at a visit, or apart from both. What is known of it are its revisions.

    `policy_id` is what ran where no session tells it, such as before the recording of a visit is uploaded. `entry_key` is the name that
    an entry had on the device where it was made, so that one sent twice is one event.
    """

    __tablename__ = "adverse_event"
    __table_args__ = (UniqueConstraint("participant_id", "entry_key"), CheckConstraint("entry_key <> ''", name="entry_key"))

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"))
    visit_id: Mapped[int | None] = mapped_column(ForeignKey("visit.id"), index=True)
    session_id: Mapped[int | None] = mapped_column(ForeignKey("session.id"), index=True)
    policy_id: Mapped[int | None] = mapped_column(ForeignKey("policy.id"), index=True)
    occurred_at: Mapped[datetime | None]
    entry_key: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    participant: Mapped[Participant] = relationship()
    visit: Mapped[Visit | None] = relationship()
    session: Mapped[StudySession | None] = relationship()
    revisions: Mapped[list[AdverseEventRevision]] = relationship(order_by="AdverseEventRevision.revision")

    @property
    def now(self) -> AdverseEventRevision:
        """What is known of it; an event always has a revision."""
        return self.revisions[-1]

    @property
    def blocks(self) -> bool:
        """Whether it is serious and no clinician has cleared it since it was last described."""
        return self.now.serious and self.now.cleared_reason is None


class AdverseEventRevision(Base):
    """What is known of an adverse event. Never changed, only followed: a correction takes back what a clinician cleared before it."""

    __tablename__ = "adverse_event_revision"
    __table_args__ = (
        UniqueConstraint("event_id", "revision"),
        CheckConstraint("severity in ('none', 'mild', 'severe')", name="severity"),
        CheckConstraint("severity = 'none' or kind is not null", name="kind_stated"),
        CheckConstraint("severity <> 'none' or not serious", name="serious"),
        CheckConstraint("kind <> 'other' or severity = 'none' or note <> ''", name="other_described"),
        CheckConstraint("cleared_reason is null or cleared_reason <> ''", name="cleared_reason"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    event_id: Mapped[int] = mapped_column(ForeignKey("adverse_event.id"))
    revision: Mapped[int]
    kind: Mapped[EventKind | None] = mapped_column(String(30))
    severity: Mapped[Severity] = mapped_column(String(10))
    serious: Mapped[bool]
    note: Mapped[str] = mapped_column(Text, server_default="")
    cleared_reason: Mapped[str | None] = mapped_column(Text)
    """Why a clinician holds that it does not stand against what ran; None where nobody did."""
    entered_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
