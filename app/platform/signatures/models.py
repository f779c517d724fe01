"""The table of electronic signatures."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import CheckConstraint, ForeignKey, Index, String, func
from sqlalchemy.orm import Mapped, mapped_column

from app.platform.database import Base


class Signature(Base):
    """A person signed something: its content as it was, and the hash that any later content is held against. Insert only."""

    __tablename__ = "signature"
    __table_args__ = (
        Index("ix_signature_subject", "subject_kind", "subject_id"),
        CheckConstraint("sha256 ~ '^[0-9a-f]{64}$'", name="sha256"),
        CheckConstraint("meaning <> '' and subject_kind <> ''", name="stated"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    subject_kind: Mapped[str] = mapped_column(String(40))
    subject_id: Mapped[int]
    meaning: Mapped[str] = mapped_column(String(200))
    sha256: Mapped[str] = mapped_column(String(64))
    content: Mapped[dict[str, Any]]
    signed_by: Mapped[int] = mapped_column(ForeignKey("app_user.id"))
    signer: Mapped[str] = mapped_column(String(254))
    """The signer's address when it was signed."""
    signed_at: Mapped[datetime] = mapped_column(server_default=func.clock_timestamp())
