"""HTML page of the energy and of a battery's life."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse

from app.accounts.deps import CurrentCaller
from app.analysis import energy
from app.analysis.energy import MEASURES, SHARES, BatteryIn, BatteryOut, BatteryRow, BatteryRowOut, Energy, EnergyOut, ImplantIn, MeasureOut
from app.analysis.figures import csv_of
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.csv_files import download
from app.platform.web.forms import parse
from app.platform.web.schemas import problems
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant
from app.study.recordings.history import readings

# Energy as API types and as rows of a table.

CSV_COLUMNS = ("participant", "measure", "unit", "controller", "mean", "saved_percent", "sessions", "definition")
BATTERY_COLUMNS = ("participant", "controller", "days_low", "days_high", "sessions", *ImplantIn.model_fields)


def energy_out(found: Energy) -> EnergyOut:
    """Convert all measures of all controllers to the schema."""
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
    """List one row per measure and controller."""
    return [
        (found.participant, r.measure, r.unit, r.controller.value, r.mean, r.saved_percent, len(r.session_ids), r.definition)
        for r in energy_out(found).rows
    ]


def battery_out(found: Energy, rows: Sequence[BatteryRow], stated: ImplantIn) -> BatteryOut:
    """Convert the battery days of every controller to the schema."""
    days = [
        BatteryRowOut(controller=r.controller, days_low=r.days.low, days_high=r.days.high, session_ids=list(r.session_ids)) for r in rows
    ]
    return BatteryOut(participant=found.participant, source=stated.source, rows=days)


def battery_csv_rows(found: Energy, rows: Sequence[BatteryRow], stated: ImplantIn) -> list[tuple[object, ...]]:
    """List one row per controller, with the assumptions."""
    assumed = [getattr(stated, name) for name in ImplantIn.model_fields]
    return [(found.participant, r.controller.value, r.days.low, r.days.high, len(r.session_ids), *assumed) for r in rows]


# REST routes of the energy.

api = APIRouter(tags=["analysis"], responses=problems(401, 403, 404, 422))


@api.get(
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
    """Return the energy of stimulation by controller: mean a, a squared, all sides and programs, charge, and TEED where an impedance is
    stated.
    """
    found = energy.energy(db, participant, caller, impedance_ohm)
    if format == "csv":
        return download(csv_of(CSV_COLUMNS, csv_rows(found)), f"{participant.code}-energy.csv")
    return energy_out(found)


@api.get(
    "/participants/{code}/analyses/battery",
    response_model=BatteryOut,
    responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},
)
def read_battery(
    participant: CurrentParticipant, db: Db, caller: CurrentCaller, stated: Annotated[BatteryIn, Query()]
) -> BatteryOut | Response:
    """Return the days of one charge, or of a primary cell, if a controller ran all the time; under assumptions that the query states."""
    found = energy.energy(db, participant, caller)
    rows = energy.battery(found, stated)
    if stated.format == "csv":
        return download(csv_of(BATTERY_COLUMNS, battery_csv_rows(found, rows, stated)), f"{participant.code}-battery.csv")
    return battery_out(found, rows, stated)


pages = APIRouter()

FIELDS = {
    "capacity_low_mah": ("Capacity of the battery, at least", "mAh"),
    "capacity_high_mah": ("Capacity of the battery, at most", "mAh"),
    "voltage_v": ("Voltage of the battery", "V"),
    "other_drain_uw": ("All other drain", "\u00b5W"),
    "impedance_ohm": ("Impedance of the contacts", "ohm"),
    "supply_v": ("Supply of the output stage", "V"),
    "pulse_width_us": ("Pulse width", "\u00b5s"),
    "rate_hz": ("Rate", "Hz"),
    "cdbs_ma": ("cDBS amplitude", "mA"),
    "source": ("Where these numbers are from", ""),
}


@pages.get("/participants/{code}/analyses/energy")
def energy_page(
    request: Request,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    impedance: Annotated[float | None, Query(gt=0, le=100_000, allow_inf_nan=False)] = None,
) -> HTMLResponse:
    """Show every measure of energy with its definition; days of a battery under assumptions that the page's form states."""
    found = energy.energy(db, participant, caller, impedance)
    typed = {name: request.query_params.get(name, "") for name in FIELDS}
    rows, problem, implant = list[energy.BatteryRow](), None, None
    if any(typed.values()):
        try:
            stated = parse(ImplantIn, typed, {name: label for name, (label, _) in FIELDS.items()})
            rows, implant = energy.battery(found, stated), stated
        except BetaloopError as error:
            problem = error
    page = render(
        request,
        "analysis/energy.html",
        participant=participant,
        found=found,
        measures=MEASURES,
        shares=SHARES,
        impedance=impedance,
        fields=FIELDS,
        typed=typed,
        battery=rows,
        readings=readings(db, participant.id),
        implant=implant,
        problem=problem.problem(request.url.path) if problem else None,
    )
    return HTMLResponse(page, problem.status if problem else 200)


@pages.get("/participants/{code}/analyses/energy.csv")
def energy_table(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Download every measure of energy as a table."""
    return download(csv_of(CSV_COLUMNS, csv_rows(energy.energy(db, participant, caller))), f"{participant.code}-energy.csv")
