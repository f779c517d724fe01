"""Table of the doses of medication taken at a visit."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, ForeignKey, Index, String, func
from sqlalchemy.orm import Mapped, mapped_column

from app.platform.database import ONE_STANDING, Base
from app.study.doses.drugs import Drug


class Dose(Base):
    """One dose that bears on a visit, taken in the clinic or before it. A wrong one is marked as
    removed, for a reason that the audit trail keeps, and counts no more."""

    __tablename__ = "dose"
    __table_args__ = (
        Index("uq_dose_visit_id_drug_taken_at", "visit_id", "drug", "taken_at", **ONE_STANDING),
        CheckConstraint(f"drug in ({', '.join(repr(d.value) for d in Drug)})", name="drug"),
        CheckConstraint("mg > 0 and mg <= 5000", name="mg"),
        CheckConstraint("taken_at >= '1990-01-01Z' and taken_at < '2201-01-01Z'", name="taken_at"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    visit_id: Mapped[int] = mapped_column(ForeignKey("visit.id"), index=True)
    drug: Mapped[Drug] = mapped_column(String(30))
    mg: Mapped[float]
    taken_at: Mapped[datetime]
    entered_by: Mapped[str] = mapped_column(String(254))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    removed_at: Mapped[datetime | None]
