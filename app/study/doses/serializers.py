"""Rows of doses as API types."""

from __future__ import annotations

from app.study.doses.drugs import DRUGS, levodopa_equivalent_mg
from app.study.doses.schemas import DoseOut
from app.tables.visits import Dose, Drug


def dose_out(row: Dose) -> DoseOut:
    """A dose with its levodopa equivalent."""
    drug = Drug(row.drug)
    return DoseOut(
        levodopa_equivalent_mg=levodopa_equivalent_mg(drug, row.mg),
        counts_for_time=DRUGS[drug].within_hours,
        **{n: getattr(row, n) for n in ("id", "visit_id", "drug", "mg", "taken_at", "entered_by", "created_at")},
    )
