"""Tables of evaluation: one run over one snapshot, and its estimates."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import (
    CheckConstraint,
    ForeignKey,
    String,
    UniqueConstraint,
    func,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base


class Evaluation(Base):
    """Every candidate policy estimated on one buffer snapshot under one settings version: what a ranking is made of."""

    __tablename__ = "evaluation"
    __table_args__ = (UniqueConstraint("job_id", "first_answer"), CheckConstraint("horizon_steps >= 1", name="horizon"))

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    snapshot_id: Mapped[int] = mapped_column(ForeignKey("buffer_snapshot.id"))
    settings_version_id: Mapped[int] = mapped_column(ForeignKey("settings_version.id"))
    job_id: Mapped[str | None] = mapped_column(ForeignKey("job.id"))
    first_answer: Mapped[bool] = mapped_column(server_default="false")
    horizon_steps: Mapped[int]
    gamma: Mapped[float]
    default_method: Mapped[str] = mapped_column(String(40))
    config: Mapped[dict[str, Any]]
    diagnostics: Mapped[dict[str, Any]]
    code_version: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    estimates: Mapped[list[EstimateRow]] = relationship(back_populates="evaluation", cascade="all, delete-orphan")


class EstimateRow(Base):
    """One method's estimate of one policy's return E[r_end + sum over t < H of gamma^t r_t], and what else it predicts."""

    __tablename__ = "estimate"
    __table_args__ = (
        UniqueConstraint("evaluation_id", "policy_id", "method"),
        CheckConstraint("low <= value and value <= high", name="interval"),
        CheckConstraint("level > 0 and level < 1", name="level"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    evaluation_id: Mapped[int] = mapped_column(ForeignKey("evaluation.id", ondelete="CASCADE"))
    policy_id: Mapped[int] = mapped_column(ForeignKey("policy.id"), index=True)
    method: Mapped[str] = mapped_column(String(40))
    value: Mapped[float]
    low: Mapped[float]
    high: Mapped[float]
    level: Mapped[float]
    standard_error: Mapped[float | None]
    supported: Mapped[bool]
    flags: Mapped[list[Any]]
    predicted: Mapped[dict[str, Any]]
    details: Mapped[dict[str, Any]]
    evaluation: Mapped[Evaluation] = relationship(back_populates="estimates")
