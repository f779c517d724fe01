"""Tables of learning: buffer snapshots and policies."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Any

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


class BufferSnapshot(Base):
    """The replay buffer as it was: everything a result depends on, pinned, and stored as Parquet."""

    __tablename__ = "buffer_snapshot"
    __table_args__ = (
        UniqueConstraint("participant_id", "pins_sha256"),
        CheckConstraint("sessions >= 1 and steps >= 1", name="not_empty"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    settings_version_id: Mapped[int] = mapped_column(ForeignKey("settings_version.id"))
    characteristics_id: Mapped[int | None] = mapped_column(ForeignKey("characteristics_version.id"))
    """The participant's characteristics of the time; None if none were stated."""
    pins_sha256: Mapped[str] = mapped_column(String(64))
    file_sha256: Mapped[str] = mapped_column(ForeignKey("stored_file.sha256"))
    sessions: Mapped[int]
    steps: Mapped[int]
    median_steps: Mapped[int]
    beta_unit: Mapped[str] = mapped_column(String(40))
    beta_source: Mapped[str] = mapped_column(String(40))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    members: Mapped[list[SnapshotSession]] = relationship(order_by="SnapshotSession.session_id", cascade="all, delete-orphan")


class SnapshotSession(Base):
    """One session of a snapshot: the versions of everything it was made of, or the reason why it is excluded."""

    __tablename__ = "snapshot_session"
    __table_args__ = (CheckConstraint("(left_out_reason is null) = (steps is not null)", name="in_or_out"),)

    snapshot_id: Mapped[int] = mapped_column(ForeignKey("buffer_snapshot.id", ondelete="CASCADE"), primary_key=True)
    session_id: Mapped[int] = mapped_column(ForeignKey("session.id"), primary_key=True, index=True)
    beta_trace_id: Mapped[int | None] = mapped_column(ForeignKey("trace.id"))
    amplitude_trace_id: Mapped[int | None] = mapped_column(ForeignKey("trace.id"))
    decode_version: Mapped[int | None]
    qoc_id: Mapped[int | None] = mapped_column(ForeignKey("qoc.id"))
    conditions_id: Mapped[int | None] = mapped_column(ForeignKey("session_conditions.id"))
    cdbs_amplitude_ma: Mapped[float | None]
    hours_since_dose: Mapped[float | None]
    steps: Mapped[int | None]
    left_out_reason: Mapped[str | None] = mapped_column(Text)


class GateChoice(StrEnum):
    """Decision of a clinician about sessions of learned policies."""

    OPEN = "open"
    SHUT = "shut"
    TEST = "test"


class BufferGateDecision(Base):
    """A clinician's word on whether sessions of learned policies enter a participant's replay buffer; the newest holds. Insert only."""

    __tablename__ = "buffer_gate_decision"
    __table_args__ = (
        CheckConstraint("choice in ('open', 'shut', 'test')", name="choice"),
        CheckConstraint("reason <> ''", name="reason"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    choice: Mapped[GateChoice] = mapped_column(String(10))
    reason: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))


class Sweep(Base):
    """Policies trained in one action on one snapshot, to be compared with each other and with controllers that learn nothing."""

    __tablename__ = "sweep"
    __table_args__ = (UniqueConstraint("participant_id", "name"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    name: Mapped[str] = mapped_column(String(100))
    snapshot_id: Mapped[int] = mapped_column(ForeignKey("buffer_snapshot.id"))
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id"), unique=True)
    config: Mapped[dict[str, Any]]
    baselines: Mapped[dict[str, Any]]
    code_version: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    policies: Mapped[list[Policy]] = relationship(back_populates="sweep", order_by="Policy.id")


class Policy(Base):
    """A trained controller. Immutable: a better one is a new policy."""

    __tablename__ = "policy"
    __table_args__ = (
        UniqueConstraint("participant_id", "name"),
        CheckConstraint("kind in ('trained', 'distilled', 'external', 'baseline')", name="kind"),
        CheckConstraint("(kind = 'distilled') = (teacher_id is not null)", name="teacher"),
        CheckConstraint("kind not in ('trained', 'distilled') or snapshot_id is not null", name="snapshot"),
        # a compute step that is repeated after a crash finds its policy instead of making a second one
        UniqueConstraint("job_id", "job_step"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    name: Mapped[str] = mapped_column(String(100))
    kind: Mapped[str] = mapped_column(String(20))
    algorithm: Mapped[str] = mapped_column(String(40))
    teacher_id: Mapped[int | None] = mapped_column(ForeignKey("policy.id"))
    parent_id: Mapped[int | None] = mapped_column(ForeignKey("policy.id"))
    snapshot_id: Mapped[int | None] = mapped_column(ForeignKey("buffer_snapshot.id"))
    settings_version_id: Mapped[int] = mapped_column(ForeignKey("settings_version.id"))
    job_id: Mapped[str | None] = mapped_column(ForeignKey("job.id"), index=True)
    job_step: Mapped[str | None] = mapped_column(String(100))
    sweep_id: Mapped[int | None] = mapped_column(ForeignKey("sweep.id"), index=True)
    config: Mapped[dict[str, Any]]
    seed: Mapped[int | None]
    onnx_sha256: Mapped[str] = mapped_column(ForeignKey("stored_file.sha256"))
    checkpoint_sha256: Mapped[str | None] = mapped_column(ForeignKey("stored_file.sha256"))
    metrics: Mapped[dict[str, Any]]
    code_version: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    retired_reason: Mapped[str | None] = mapped_column(Text)
    sweep: Mapped[Sweep | None] = relationship(back_populates="policies")
