"""Energy as API types and as rows of a table."""

from __future__ import annotations

from collections.abc import Sequence

from app.analysis.energy.schemas import BatteryOut, BatteryRowOut, EnergyOut, ImplantIn, MeasureOut
from app.analysis.energy.service import BatteryRow, Energy
from app.analysis.energy.wording import MEASURES

CSV_COLUMNS = ("participant", "measure", "unit", "controller", "mean", "saved_percent", "sessions", "definition")
BATTERY_COLUMNS = ("participant", "controller", "days_low", "days_high", "sessions", *ImplantIn.model_fields)


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


def battery_out(found: Energy, rows: Sequence[BatteryRow], stated: ImplantIn) -> BatteryOut:
    """Days of every controller."""
    days = [
        BatteryRowOut(controller=r.controller, days_low=r.days.low, days_high=r.days.high, session_ids=list(r.session_ids)) for r in rows
    ]
    return BatteryOut(participant=found.participant, source=stated.source, rows=days)


def battery_csv_rows(found: Energy, rows: Sequence[BatteryRow], stated: ImplantIn) -> list[tuple[object, ...]]:
    """One row per controller, with the assumptions."""
    assumed = [getattr(stated, name) for name in ImplantIn.model_fields]
    return [(found.participant, r.controller.value, r.days.low, r.days.high, len(r.session_ids), *assumed) for r in rows]
