"""Tables of files: bytes that the service stores, uploads, and what was made of them."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    ForeignKey,
    Index,
    String,
    Text,
    UniqueConstraint,
    func,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base
from app.tables.sessions import StudySession
from ml.formats.tables.mapping import TableMapping


class StoredFile(Base):
    """Bytes that the content-addressed folder holds."""

    __tablename__ = "stored_file"
    __table_args__ = (CheckConstraint("sha256 ~ '^[0-9a-f]{64}$'", name="sha256"), CheckConstraint("size >= 0", name="size"))

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    size: Mapped[int] = mapped_column(BigInteger)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())


PREVIEW = "preview"
"""Member of a file's report: what may be shown of a table that waits for a column mapping."""


class Upload(Base):
    """One call of the upload route, with the fields its sender stated."""

    __tablename__ = "upload"
    __table_args__ = (CheckConstraint("status in ('received', 'decoded', 'failed')", name="status"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    status: Mapped[str] = mapped_column(String(20), server_default="received")
    stated: Mapped[dict[str, Any]]
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    files: Mapped[list[UploadFile]] = relationship(back_populates="upload", order_by="UploadFile.id")


class UploadFile(Base):
    """One file of an upload. The original's hash makes uploads idempotent; what is kept is the file without identity.

    What could not be parsed, whole or in part, could not be cleaned: the original is kept encrypted then, as `quarantine_sha256`.
    """

    __tablename__ = "upload_file"
    __table_args__ = (
        CheckConstraint("status in ('received', 'decoded', 'failed', 'released', 'discarded')", name="status"),
        CheckConstraint(
            "(decided_at is null) = (decided_by is null) and (decided_at is null) = (decision_reason is null)", name="decision"
        ),
        # one participant's file counts once; a file that could not be used may be tried again
        Index(
            "uq_upload_file_participant_original",
            "participant_id",
            "original_sha256",
            unique=True,
            postgresql_where="status = 'decoded'",
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    upload_id: Mapped[int] = mapped_column(ForeignKey("upload.id"), index=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    name: Mapped[str] = mapped_column(String(255))
    kind: Mapped[str] = mapped_column(String(40), server_default="unknown")
    size: Mapped[int] = mapped_column(BigInteger)
    original_sha256: Mapped[str] = mapped_column(String(64), index=True)
    stored_sha256: Mapped[str | None] = mapped_column(ForeignKey("stored_file.sha256"))
    quarantine_sha256: Mapped[str | None] = mapped_column(ForeignKey("stored_file.sha256"))
    redactor_version: Mapped[int | None]
    status: Mapped[str] = mapped_column(String(20), server_default="received")
    report: Mapped[dict[str, Any]]
    session_id: Mapped[int | None] = mapped_column(ForeignKey("session.id", ondelete="SET NULL"), index=True)
    """The session that a file without a clock of its own (a grasp test) was attached to."""
    released_sha256: Mapped[str | None] = mapped_column(ForeignKey("stored_file.sha256"))
    """The original as it came, after a person has reviewed it and released it."""
    reviewed_by: Mapped[str | None] = mapped_column(String(254))
    reviewed_at: Mapped[datetime | None]
    decided_by: Mapped[str | None] = mapped_column(String(254))
    decided_at: Mapped[datetime | None]
    decision_reason: Mapped[str | None] = mapped_column(Text)
    column_mapping_id: Mapped[int | None] = mapped_column(ForeignKey("column_mapping.id"), index=True)
    """The version of the column mapping that read this table."""
    upload: Mapped[Upload] = relationship(back_populates="files")
    column_mapping: Mapped[ColumnMapping | None] = relationship()

    @property
    def preview(self) -> dict[str, Any] | None:
        """Preview of a table that waits for a column mapping (`ml.formats.tables.mapping.preview_of`); None for other files."""
        waits = self.status == "failed" and self.quarantine_sha256 is not None
        found: dict[str, Any] | None = (self.report or {}).get(PREVIEW)
        return found if waits else None


class ColumnMapping(Base):
    """Meaning of the columns of tables with the same header, in one study. Never changed, only followed by a newer version.

    `header` is the keyed hash of the line that names the columns. A version that is `removed` ends a mapping: the next table asks again.
    """

    __tablename__ = "column_mapping"
    __table_args__ = (UniqueConstraint("study_id", "header", "version"), CheckConstraint("version >= 1", name="version"))

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    header: Mapped[str] = mapped_column(String(64))
    version: Mapped[int]
    name: Mapped[str] = mapped_column(String(100))
    mapping: Mapped[dict[str, Any]]
    labels: Mapped[dict[str, Any]]
    """By column number, what the preview showed of its name."""
    removed: Mapped[bool] = mapped_column(server_default="false")
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)

    @property
    def as_mapping(self) -> TableMapping:
        """As the readers take it."""
        return TableMapping.from_json(self.mapping)


class SignalMeaning(Base):
    """Meaning of a marker, or of an amplitude channel without a unit, in one study. Never changed, only followed by a newer version.

    `key` is that of `ml.formats.labs.meanings`: a keyed hash of the marker's words, its code, or the name of the channel. `shown` has those
    words that may be shown. A version that is `removed` ends a meaning: the marker is asked about again.
    """

    __tablename__ = "signal_meaning"
    __table_args__ = (UniqueConstraint("study_id", "key", "version"), CheckConstraint("version >= 1", name="version"))

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    key: Mapped[str] = mapped_column(String(80))
    version: Mapped[int]
    shown: Mapped[str] = mapped_column(String(100))
    meaning: Mapped[dict[str, Any]]
    removed: Mapped[bool] = mapped_column(server_default="false")
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)


class SessionProposal(Base):
    """Evidence for a session that an upload proposes, and the number of its changes. The row stays after the session is confirmed.

    `evidence` has an `app.ingest.evidence.Evidence` per field (`visit`, `controller`, …), in old rows a sentence. Where
    `visit_open`, the visit is a place to store the proposal in and no guess. `version` lets no tab overwrite another's correction.
    """

    __tablename__ = "session_proposal"
    __table_args__ = (CheckConstraint("version >= 1", name="version"),)

    session_id: Mapped[int] = mapped_column(ForeignKey("session.id", ondelete="CASCADE"), primary_key=True)
    upload_id: Mapped[int] = mapped_column(ForeignKey("upload.id"), index=True)
    version: Mapped[int] = mapped_column(server_default="1")
    visit_open: Mapped[bool]
    evidence: Mapped[dict[str, Any]]
    changed_by: Mapped[str] = mapped_column(String(254))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    session: Mapped[StudySession] = relationship()
