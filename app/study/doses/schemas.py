"""API types of doses."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from app.platform.web.schemas import Model, Moment, Number, Text
from app.tables.visits import Drug


class DoseIn(Model):
    """A dose that was taken."""

    drug: Drug = Field(description="`levodopa_equivalent`: everything taken at that time together, as mg of levodopa.")
    mg: Number = Field(gt=0, le=5000, description="Of the active drug, mg; of levodopa combinations the levodopa (100 of a 25/100 tablet).")
    taken_at: Moment = Field(description="Without an offset it is UTC. Within three days before the visit, or on its day.")


class DoseRemoval(Model):
    """Why a dose that was written down is taken back."""

    reason: Text = Field(min_length=1, max_length=1000, description="Kept in the audit trail, as is the dose.")


class DoseOut(Model):
    """A dose that was taken."""

    id: int
    visit_id: int
    drug: Drug
    mg: float
    levodopa_equivalent_mg: float | None = Field(description="Null where no equivalent is stated for the drug.")
    counts_for_time: bool = Field(description="Whether the time since it counts: its effect comes and goes within hours.")
    taken_at: datetime
    entered_by: str
    created_at: datetime
