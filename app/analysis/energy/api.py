"""REST routes of the energy."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.accounts.deps import CurrentCaller
from app.analysis.energy import service
from app.analysis.energy.schemas import BatteryIn, BatteryOut, EnergyOut
from app.analysis.energy.serializers import BATTERY_COLUMNS, CSV_COLUMNS, battery_csv_rows, battery_out, csv_rows, energy_out
from app.analysis.tables import csv_of
from app.platform.database import Db
from app.platform.web.csv_files import download
from app.platform.web.schemas import problems
from app.study.deps import CurrentParticipant

router = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@router.get(
    "/participants/{code}/analyses/energy",
    response_model=EnergyOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},
)
def read_energy(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    impedance_ohm: Annotated[float | None, Query(gt=0, le=100_000, allow_inf_nan=False, description="Of the contacts, for TEED.")] = None,
    format: Annotated[Literal["json", "csv"], Query()] = "json",
) -> EnergyOut | Response:
    """What stimulation took by controller: mean a, a squared, all sides and programs, charge, and TEED where an impedance is stated."""
    found = service.energy(db, participant, caller, impedance_ohm)
    if format == "csv":
        return download(csv_of(CSV_COLUMNS, csv_rows(found)), f"{participant.code}-energy.csv")
    return energy_out(found)


@router.get(
    "/participants/{code}/analyses/battery",
    response_model=BatteryOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},
)
def read_battery(
    participant: CurrentParticipant, db: Db, caller: CurrentCaller, stated: Annotated[BatteryIn, Query()]
) -> BatteryOut | Response:
    """Days of one charge, or of a primary cell, if a controller ran all the time; under assumptions that the query states."""
    found = service.energy(db, participant, caller)
    rows = service.battery(found, stated)
    if stated.format == "csv":
        return download(csv_of(BATTERY_COLUMNS, battery_csv_rows(found, rows, stated)), f"{participant.code}-battery.csv")
    return battery_out(found, rows, stated)
