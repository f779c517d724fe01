"""Tables of data queries: what is asked about, and what was said, entry by entry. Rows are only added."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum

from sqlalchemy import CheckConstraint, ForeignKey, String, Text, func
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base
from app.study.models import Participant, StudySession


class QueryState(StrEnum):
    """Where a query stands after an entry: it waits for an answer, for whoever asked, or for nobody."""

    OPEN = "open"
    ANSWERED = "answered"
    CLOSED = "closed"


class QueriedField(StrEnum):
    """What of a session or an upload is asked about; anything else is `other`, said in the text."""

    GRASP_HZ = "grasp_hz"
    RATING = "rating"
    TREMOR_PERCENT = "tremor_percent"
    CONTROLLER = "controller"
    STARTED_AT = "started_at"
    HEMISPHERE = "hemisphere"
    MEDICATION_H = "medication_h"
    STOPPED_REASON = "stopped_reason"
    FILE = "file"
    OTHER = "other"


class DataQuery(Base):
    """A question about one value of a session, or about an upload. What was said, and its state, are its entries."""

    __tablename__ = "data_query"
    __table_args__ = (CheckConstraint("(session_id is null) <> (upload_id is null)", name="one_subject"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    session_id: Mapped[int | None] = mapped_column(ForeignKey("session.id"), index=True)
    upload_id: Mapped[int | None] = mapped_column(ForeignKey("upload.id"), index=True)
    field: Mapped[QueriedField] = mapped_column(String(20))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    participant: Mapped[Participant] = relationship()
    session: Mapped[StudySession | None] = relationship()
    entries: Mapped[list[DataQueryEntry]] = relationship(order_by="DataQueryEntry.id")

    @property
    def state(self) -> QueryState:
        """Where it stands; a query always has an entry."""
        return QueryState(self.entries[-1].state)


class DataQueryEntry(Base):
    """Something said about a query, with the value as it stood at that moment: a correction leaves the old one readable here."""

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
