"""HTML page of the energy and of a battery's life."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse

from app.accounts.deps import CurrentCaller
from app.analysis.energy import service
from app.analysis.energy.schemas import ImplantIn
from app.analysis.energy.serializers import CSV_COLUMNS, csv_rows
from app.analysis.energy.wording import MEASURES, SHARES
from app.analysis.tables import csv_of
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.csv_files import download
from app.platform.web.forms import parse
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant
from app.study.recordings.battery import readings

router = APIRouter()

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


@router.get("/participants/{code}/analyses/energy")
def energy_page(
    request: Request,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    impedance: Annotated[float | None, Query(gt=0, le=100_000, allow_inf_nan=False)] = None,
) -> HTMLResponse:
    """Every measure of energy with its definition; days of a battery under assumptions that the page's form states."""
    found = service.energy(db, participant, caller, impedance)
    typed = {name: request.query_params.get(name, "") for name in FIELDS}
    rows, problem, implant = list[service.BatteryRow](), None, None
    if any(typed.values()):
        try:
            stated = parse(ImplantIn, typed, {name: label for name, (label, _) in FIELDS.items()})
            rows, implant = service.battery(found, stated), stated
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


@router.get("/participants/{code}/analyses/energy.csv")
def energy_table(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Every measure of energy as a table."""
    return download(csv_of(CSV_COLUMNS, csv_rows(service.energy(db, participant, caller))), f"{participant.code}-energy.csv")
