"""Tables of recordings. A recording belongs to a device and a clock and is not a session: `SessionSegment` links the two."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import (
    CheckConstraint,
    ForeignKey,
    LargeBinary,
    String,
    UniqueConstraint,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base
from app.tables.participants import HEMISPHERE_CHECK, Hemisphere

TIME_CHECK = "started_at >= '1990-01-01Z' and started_at < '2201-01-01Z'"


class Device(Base):
    """An implant or another source of recordings, under a keyed pseudonym."""

    __tablename__ = "device"
    __table_args__ = (UniqueConstraint("participant_id", "pseudonym"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    pseudonym: Mapped[str] = mapped_column(String(64))
    kind: Mapped[str] = mapped_column(String(40))


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


class Trace(Base):
    """A 2 s trace of a recording: beta amplitude, amplitude in mA, band power. Row i ends at `first_end_s + i dt_s`.

    `values_f32` is little-endian float32, `valid_bits` numpy.packbits of the valid mask; both have `n` entries.
    """

    __tablename__ = "trace"
    __table_args__ = (
        UniqueConstraint("recording_id", "decode_version", "reading", "stream", "channel"),
        CheckConstraint("n >= 0 and dt_s > 0 and octet_length(values_f32) = 4 * n", name="length"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    recording_id: Mapped[int] = mapped_column(ForeignKey("recording.id", ondelete="CASCADE"))
    decode_version: Mapped[int]
    reading: Mapped[int] = mapped_column(server_default="1")
    """Number of the reading by this version: a further one follows when the lab states what markers and channels mean."""
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
