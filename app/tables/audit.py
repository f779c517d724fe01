"""Tables of the audit trail and of electronic signatures."""

from __future__ import annotations

import hashlib
from datetime import datetime
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa
from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    ForeignKey,
    Index,
    LargeBinary,
    String,
    Text,
    func,
)
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import Mapped, column_property, mapped_column

from app.platform.database import Base

GENESIS = hashlib.sha256(b"betaloop audit trail").digest()


class AuditEvent(Base):
    """One change of a row: who, when, from what to what, and why. Insert only: a trigger refuses updates and deletions."""

    __tablename__ = "audit_event"
    __table_args__ = (Index("ix_audit_event_entity", "entity", "entity_id"),)

    id: Mapped[int] = mapped_column(BigInteger, primary_key=True)
    at: Mapped[datetime] = mapped_column(server_default=func.clock_timestamp(), index=True)
    actor: Mapped[str] = mapped_column(String(254))
    user_id: Mapped[int | None]
    request_id: Mapped[str | None] = mapped_column(String(64))
    action: Mapped[str] = mapped_column(String(10))
    entity: Mapped[str] = mapped_column(String(63))
    entity_id: Mapped[str] = mapped_column(String(200))
    before: Mapped[dict[str, Any] | None]
    after: Mapped[dict[str, Any] | None]
    reason: Mapped[str | None] = mapped_column(Text)


class AuditLink(Base):
    """The place of a row of the trail in the chain. Insert only, and by the trigger alone.

    There is no foreign key: a row that was removed from the trail must stay seen.
    """

    __tablename__ = "audit_link"

    position: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    event_id: Mapped[int] = mapped_column(BigInteger, unique=True)
    digest: Mapped[bytes] = mapped_column(LargeBinary)


class AuditSeal(Base):
    """The digest of the chain at a place, under the key of the installation. Insert only."""

    __tablename__ = "audit_seal"

    position: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    digest: Mapped[bytes] = mapped_column(LargeBinary)
    mac: Mapped[bytes] = mapped_column(LargeBinary)
    made_at: Mapped[datetime] = mapped_column(server_default=func.clock_timestamp())


class Signature(Base):
    """Signature of a person: the content signed, and its hash, against which later content is checked. Insert only."""

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
    if TYPE_CHECKING:  # mapped below, as it asks for this table too
        recorded: Mapped[dict[str, Any] | None]
        """The signature as the audit trail took it down, without its content; None where its entry is gone or does not fit the chain."""


_ENTRY = AuditEvent.__table__.alias("signed_entry")

_LINK, _BEFORE = (AuditLink.__table__.alias(name) for name in ("own", "before"))

_FITS = _LINK.c.digest == func.audit_digest(func.coalesce(_BEFORE.c.digest, GENESIS), sa.literal_column("signed_entry"))

# links are made at the commit: the entry of a signature that this transaction gives has none yet
_OWN = sa.literal_column("signed_entry.xmin = pg_current_xact_id_if_assigned()::xid", sa.Boolean)

Signature.recorded = column_property(
    sa.select(sa.cast(sa.case((sa.or_(_FITS, _LINK.c.position.is_(None) & _OWN), _ENTRY.c.after)), JSONB))
    .select_from(_ENTRY.outerjoin(_LINK, _LINK.c.event_id == _ENTRY.c.id).outerjoin(_BEFORE, _BEFORE.c.position == _LINK.c.position - 1))
    .where(_ENTRY.c.entity == "signature", _ENTRY.c.action == "insert", _ENTRY.c.entity_id == sa.cast(Signature.id, String))
    .order_by(_ENTRY.c.id)
    .limit(1)
    .correlate(Signature.__table__)
    .scalar_subquery()
)
