"""Energy as API types and as rows of a table."""

from __future__ import annotations

from app.analysis.energy.schemas import EnergyOut, MeasureOut
from app.analysis.energy.service import Energy
from app.analysis.energy.wording import MEASURES

CSV_COLUMNS = ("participant", "measure", "unit", "controller", "mean", "saved_percent", "sessions", "definition")


def energy_out(found: Energy) -> EnergyOut:
    """All measures of all controllers."""
    rows = []
    for r in found.rows:
        title, unit, definition = MEASURES[r.measure]
        rows.append(
            MeasureOut(
                measure=r.measure,
                title=title,
                unit=unit,
                definition=definition,
                controller=r.controller,
                mean=r.mean,
                saved_percent=r.saved_percent,
                session_ids=list(r.session_ids),
            )
        )
    return EnergyOut(participant=found.participant, rows=rows, unknown_sides=found.unknown_sides)


def csv_rows(found: Energy) -> list[tuple[object, ...]]:
    """One row per measure and controller."""
    return [
        (found.participant, r.measure, r.unit, r.controller.value, r.mean, r.saved_percent, len(r.session_ids), r.definition)
        for r in energy_out(found).rows
    ]
