"""Tables of background jobs: our own record of jobs and their results; the engine's tables only carry them out."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
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


class JobStatus(StrEnum):
    """Life of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def ended(self) -> bool:
        """Nothing more will happen."""
        return self in {JobStatus.SUCCEEDED, JobStatus.FAILED, JobStatus.CANCELLED}


_LEAST_PROGRESS = 0.05

_STATUS_CHECK = "status in ('queued', 'running', 'succeeded', 'failed', 'cancelled')"


class Job(Base):
    """One piece of background work that a person (or a plan) asked for."""

    __tablename__ = "job"
    __table_args__ = (
        CheckConstraint(_STATUS_CHECK, name="status"),
        CheckConstraint("progress >= 0 and progress <= 1", name="progress"),
        CheckConstraint("(finished_at is not null) = (status in ('succeeded', 'failed', 'cancelled'))", name="finished"),
    )

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    participant_id: Mapped[int | None] = mapped_column(ForeignKey("participant.id"), index=True)
    kind: Mapped[str] = mapped_column(String(40), index=True)
    status: Mapped[JobStatus] = mapped_column(String(20), server_default="queued")
    progress: Mapped[float] = mapped_column(server_default="0")
    message: Mapped[str] = mapped_column(Text, server_default="")
    params: Mapped[dict[str, Any]]
    result: Mapped[dict[str, Any] | None]
    error: Mapped[str | None] = mapped_column(Text)
    code_version: Mapped[str] = mapped_column(String(80))
    protocol: Mapped[int] = mapped_column(server_default="0")
    """Version of the job protocol (`app.platform.jobs.engine`) that a worker must speak at least."""
    repeats: Mapped[str | None] = mapped_column(ForeignKey("job.id"))
    """The job that had ended and that this one repeats."""
    urgency: Mapped[int] = mapped_column(server_default="50")
    """A `Priority`: smaller ones begin first."""
    place: Mapped[int] = mapped_column(server_default="0")
    """Order among waiting jobs of one urgency: studies take turns, and participants within them."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    updated_at: Mapped[datetime] = mapped_column(server_default=func.now())
    cancel_requested_at: Mapped[datetime | None]
    steps: Mapped[list[JobStep]] = relationship(back_populates="job", order_by="JobStep.position")

    def seconds_left(self, present: datetime) -> float | None:
        """Estimate the time until the end, in seconds, from the mean speed so far; None unless the job runs and has progressed enough."""
        if self.started_at is None or self.status != JobStatus.RUNNING or self.progress < _LEAST_PROGRESS:
            return None
        return (present - self.started_at).total_seconds() * (1 - self.progress) / self.progress


class JobStep(Base):
    """One compute step of a job, run in a child process of its own; `key` is stable over restarts (`train/2`)."""

    __tablename__ = "job_step"
    __table_args__ = (
        UniqueConstraint("job_id", "key"),
        CheckConstraint(_STATUS_CHECK, name="status"),
        CheckConstraint("progress >= 0 and progress <= 1", name="progress"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"), index=True)
    key: Mapped[str] = mapped_column(String(100))
    title: Mapped[str] = mapped_column(String(200))
    position: Mapped[int]
    weight: Mapped[float] = mapped_column(server_default="1")
    status: Mapped[JobStatus] = mapped_column(String(20), server_default="queued")
    progress: Mapped[float] = mapped_column(server_default="0")
    message: Mapped[str] = mapped_column(Text, server_default="")
    attempts: Mapped[int] = mapped_column(server_default="0")
    worker: Mapped[str | None] = mapped_column(String(100))
    result: Mapped[dict[str, Any] | None]
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    job: Mapped[Job] = relationship(back_populates="steps")


class JobEvent(Base):
    """Report of a job: progress, a learning-curve point or a log line, in order. Server-sent events are read from here."""

    __tablename__ = "job_event"
    __table_args__ = (Index("ix_job_event_job_id_id", "job_id", "id"),)

    id: Mapped[int] = mapped_column(BigInteger, primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"))
    step_key: Mapped[str | None] = mapped_column(String(100))
    kind: Mapped[str] = mapped_column(String(20))
    data: Mapped[dict[str, Any]]
    at: Mapped[datetime] = mapped_column(server_default=func.clock_timestamp())


class Worker(Base):
    """A worker slot and its last sign of life, by the database's clock."""

    __tablename__ = "worker"

    id: Mapped[str] = mapped_column(String(100), primary_key=True)
    host: Mapped[str] = mapped_column(String(255))
    pid: Mapped[int]
    protocol: Mapped[int]
    code_version: Mapped[str] = mapped_column(String(80))
    started_at: Mapped[datetime] = mapped_column(server_default=func.now())
    seen_at: Mapped[datetime] = mapped_column(server_default=func.now())
