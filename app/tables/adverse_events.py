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
    """Kind of an adverse event: the known side effects of stimulation. Anything else is `other`, with a note."""

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
    STOPPED = "stopped"
    """A session was stopped for the participant's sake."""
    OTHER = "other"


class Severity(StrEnum):
    """Severity of an event; `none` records that a person looked and found nothing."""

    NONE = "none"
    MILD = "mild"
    MODERATE = "moderate"
    SEVERE = "severe"
    NOT_STATED = "not_stated"


class Relation(StrEnum):
    """Relation of an event to what was tested, in the steps of ISO 14155."""

    NOT_RELATED = "not_related"
    POSSIBLE = "possible"
    PROBABLE = "probable"
    CAUSAL = "causal"


class Action(StrEnum):
    """Action taken because of an event."""

    NONE = "none"
    STIMULATION_CHANGED = "stimulation_changed"
    SESSION_STOPPED = "session_stopped"
    MEDICATION = "medication"
    OTHER = "other"


class EventOutcome(StrEnum):
    """Outcome of an event, as far as it is known."""

    RECOVERED = "recovered"
    RECOVERING = "recovering"
    NOT_RECOVERED = "not_recovered"
    LASTING_HARM = "lasting_harm"
    FATAL = "fatal"


class AdverseEvent(Base):
    """Something that happened to a participant: in a session, at a visit, or apart from both. Its revisions describe it.

    `policy_id` is the policy that ran where no session names it, such as before a visit's recording is uploaded. `entry_key` is the
    entry's name on the device where it was made: an entry sent twice is one event.
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
        """The newest revision; an event always has one."""
        return self.revisions[-1]

    @property
    def is_stop(self) -> bool:
        """True if it is a session that was stopped for the participant's sake."""
        return self.now.kind == EventKind.STOPPED and self.now.severity != Severity.NONE

    @property
    def blocks(self) -> bool:
        """True if it is serious, or a stop, and no clinician has cleared its newest revision."""
        return (self.now.serious or self.is_stop) and self.now.cleared_reason is None


class AdverseEventRevision(Base):
    """Revision of an adverse event, never changed. A correction is a new revision; it undoes an earlier clearance by a clinician."""

    __tablename__ = "adverse_event_revision"
    __table_args__ = (
        UniqueConstraint("event_id", "revision"),
        CheckConstraint("severity in ('none', 'mild', 'moderate', 'severe', 'not_stated')", name="severity"),
        CheckConstraint("relation in ('not_related', 'possible', 'probable', 'causal')", name="relation"),
        CheckConstraint("action in ('none', 'stimulation_changed', 'session_stopped', 'medication', 'other')", name="action"),
        CheckConstraint("outcome in ('recovered', 'recovering', 'not_recovered', 'lasting_harm', 'fatal')", name="outcome"),
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
    relation: Mapped[Relation | None] = mapped_column(String(20))
    ended_at: Mapped[datetime | None]
    action: Mapped[Action | None] = mapped_column(String(20))
    outcome: Mapped[EventOutcome | None] = mapped_column(String(20))
    cleared_reason: Mapped[str | None] = mapped_column(Text)
    """A clinician's reason why the event does not count against the policy that ran; None if no clinician has cleared it."""
    entered_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
