"""Tables of data queries: their subjects and their entries. Rows are only added."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum

from sqlalchemy import (
    CheckConstraint,
    ForeignKey,
    String,
    Text,
    func,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base
from app.tables.participants import Participant
from app.tables.sessions import StudySession


class QueryState(StrEnum):
    """State of a query after an entry: it waits for an answer, or for the person who asked, or is closed."""

    OPEN = "open"
    ANSWERED = "answered"
    CLOSED = "closed"


class Subject(StrEnum):
    """Kind of record that holds the value asked about."""

    SESSION = "session"
    UPLOAD = "upload"
    VISIT = "visit"
    DOSE = "dose"
    EVENT = "event"
    SETTINGS = "settings"
    CHARACTERISTICS = "characteristics"


OF_PARTICIPANT = (Subject.SETTINGS, Subject.CHARACTERISTICS)
"""Subjects of which a participant has one, in versions; the others have a number."""


class DataQuery(Base):
    """A question about one value, or about an upload. Its entries hold the texts and its state."""

    __tablename__ = "data_query"
    __table_args__ = (
        CheckConstraint("num_nonnulls(session_id, upload_id, visit_id, dose_id, event_id, record) = 1", name="one_subject"),
        CheckConstraint(f"record in ({', '.join(repr(s.value) for s in OF_PARTICIPANT)})", name="record"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    session_id: Mapped[int | None] = mapped_column(ForeignKey("session.id"), index=True)
    upload_id: Mapped[int | None] = mapped_column(ForeignKey("upload.id"), index=True)
    visit_id: Mapped[int | None] = mapped_column(ForeignKey("visit.id"), index=True)
    dose_id: Mapped[int | None]
    """Without a foreign key: a query about a dose stays when the dose is taken back."""
    event_id: Mapped[int | None] = mapped_column(ForeignKey("adverse_event.id"), index=True)
    record: Mapped[str | None] = mapped_column(String(20))
    """`settings` or `characteristics`: the participant's, whose present version holds the value."""
    field: Mapped[str] = mapped_column(String(40))
    """Which value, by its name in the API (`app.study.data_queries`)."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    participant: Mapped[Participant] = relationship()
    session: Mapped[StudySession | None] = relationship()
    entries: Mapped[list[DataQueryEntry]] = relationship(order_by="DataQueryEntry.id")

    @property
    def subject(self) -> Subject:
        """The kind of record that holds the value."""
        if self.record is not None:
            return Subject(self.record)
        return next(s for s in Subject if s not in OF_PARTICIPANT and getattr(self, f"{s.value}_id") is not None)

    @property
    def subject_id(self) -> int | None:
        """The number of the record that holds the value; None for settings and characteristics."""
        number: int | None = None if self.record is not None else getattr(self, f"{self.subject.value}_id")
        return number

    @property
    def state(self) -> QueryState:
        """The state after the newest entry; a query always has an entry."""
        return QueryState(self.entries[-1].state)


class DataQueryEntry(Base):
    """Entry of a query: a text, and the value at that moment, which stays readable here after a correction."""

    __tablename__ = "data_query_entry"
    __table_args__ = (CheckConstraint("state in ('open', 'answered', 'closed')", name="state"), CheckConstraint("text <> ''", name="text"))

    id: Mapped[int] = mapped_column(primary_key=True)
    query_id: Mapped[int] = mapped_column(ForeignKey("data_query.id"), index=True)
    state: Mapped[QueryState] = mapped_column(String(10))
    text: Mapped[str] = mapped_column(Text)
    value: Mapped[str | None] = mapped_column(Text)
    """As it stood; null where there was none, or where it is not kept here (controllers, files)."""
    entered_by: Mapped[str] = mapped_column(String(254))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
