"""HTML pages of column mappings: the form with a waiting table's preview, and the mappings of a study."""

from __future__ import annotations

import re
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.ingest import repository as uploads
from app.ingest.mappings import repository, service
from app.ingest.mappings.rules import HOLDS_NAMES, ROLE_NAMES
from app.ingest.mappings.schemas import MappingIn
from app.ingest.mappings.serializers import mappings_out
from app.ingest.mappings.service import WaitingTable
from app.ingest.quarantine.serializers import problem_of
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.schemas import RowId
from app.platform.web.templates import render
from app.tables.accounts import Study
from app.tables.uploads import ColumnMapping
from ml.formats.tables.cells.numbers import known_unit
from ml.formats.tables.mapping.model import UNITS

router = APIRouter()

TIME_FORMATS = (
    ("seconds", "seconds from the session's start"),
    ("milliseconds", "milliseconds from the session's start"),
    ("microseconds", "microseconds from the session's start"),
    ("minutes", "minutes from the session's start"),
    ("samples", "numbers of samples"),
    ("unix_s", "Unix time, seconds"),
    ("unix_ms", "Unix time, milliseconds"),
    ("unix_us", "Unix time, microseconds"),
    ("unix_ns", "Unix time, nanoseconds"),
    ("excel", "spreadsheet day numbers (Excel)"),
    ("iso", "date and time, year first: 2026-03-02 10:00:00"),
    ("dmy", "date and time, day first: 02.03.2026 10:00:00"),
    ("mdy", "date and time, month first: 03/02/2026 10:00:00"),
)
LABELS = {
    "name": "Name",
    "header_line": "Line of names",
    "unit_lines": "Lines of units",
    "holds": "The table holds",
    "time_format": "Format of times",
    "zone": "Zone",
    "rate_hz": "Rate",
    "time_at": "A step's time",
    "columns": "Columns",
    "reason": "Reason",
}
WHOLE = ("name", "header_line", "unit_lines", "holds", "time_format", "zone", "rate_hz", "time_at", "reason")
PER_COLUMN = ("role", "unit", "side", "channel")
UNIT_CHOICES = tuple(dict.fromkeys(unit for units in UNITS.values() for unit in units))


@router.get("/uploaded-files/{file_id}/mapping")
def mapping_page(request: Request, file_id: RowId, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show a waiting table's first lines, and what its columns may have."""
    table = service.waiting_table(db, file_id, caller)
    return _form_page(request, table, _stored(table.known) if table.known else _guessed(table.preview))


@router.post("/uploaded-files/{file_id}/mapping")
def read_by_mapping(request: Request, file_id: RowId, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Read a waiting table as the form says, and keep that for the study; where it fails the form comes back with the reason."""
    typed = {name: str(value) for name, value in values.items()}
    try:
        service.read_by(db, file_id, _wanted(values), caller)
    except BetaloopError as error:
        db.rollback()
        table = service.waiting_table(db, file_id, caller)
        return _form_page(request, table, typed, _at_fields(error))
    upload_id = uploads.upload_file(db, file_id, caller)[0].upload_id
    return RedirectResponse(f"/uploads/{upload_id}?done=mapped", 303)


@router.get("/studies/{study_code}/column-mappings")
def mappings_page(request: Request, study_code: str, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the column mappings of a study, those in force first."""
    return _list_page(request, db, repository.study_of(db, study_code, caller), caller)


@router.post("/column-mappings/{mapping_id}/remove")
def remove_mapping(request: Request, mapping_id: RowId, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """End a mapping."""
    row = repository.mapping(db, mapping_id, caller)
    study = db.get_one(Study, row.study_id)
    try:
        service.remove(db, mapping_id, str(values.get("reason", ""))[:1000], caller)
    except BetaloopError as error:
        db.rollback()
        return _list_page(request, db, study, caller, error, mapping_id)
    return RedirectResponse(f"/studies/{study.code}/column-mappings?done=removed", 303)


def _wanted(values: FormData) -> MappingIn:
    """Read the mapping that a form states. Raises Invalid, with every field that is wrong."""
    columns: list[dict[str, Any]] = []
    for name in values:
        if name.startswith("role_") and values[name] and name.removeprefix("role_").isdecimal():
            number = name.removeprefix("role_")
            given = {part: str(values.get(f"{part}_{number}", "")).strip() or None for part in PER_COLUMN}
            columns.append({"number": int(number), **given})
    try:
        return parse(MappingIn, {name: values.get(name, "") for name in WHOLE} | {"columns": columns}, LABELS)
    except Invalid as error:
        told = [e | {"where": _column_where(e["where"], columns)} for e in error.extra.get("errors", [])]
        raise Invalid("The table cannot be read as stated.", "Correct the fields; nothing was changed.", errors=told) from error


def _at_fields(error: BetaloopError) -> BetaloopError:
    """Assign each of an error's `errors` the form's field as its `name`; a column's is that of its row."""
    names = {label: name for name, label in LABELS.items()}
    told = [dict(e) | {"name": names.get(e["where"], e["where"].lower().replace(" ", "_"))} for e in error.extra.get("errors", ())]
    if told:
        error.extra["errors"] = told
    return error


def _column_where(where: str, columns: list[dict[str, Any]]) -> str:
    """Name `columns.2.unit` as the page does."""
    parts = where.split(".")
    if parts[0] != "columns" or len(parts) < 2 or not parts[1].isdecimal():
        return where
    return f"Column {columns[int(parts[1])]['number']}"


def _guessed(preview: dict[str, Any]) -> dict[str, str]:
    """Guess what the form begins with: lines as they look, and the units in names or below them."""
    at = next(i for i, line in enumerate(preview["lines"]) if line["number"] == preview["header_line"])
    typed = {"header_line": str(preview["header_line"]), "unit_lines": str(preview["unit_lines"])}
    near = [line["cells"] for line in preview["lines"][at : at + 1 + preview["unit_lines"]]]
    for number in range(1, preview["width"] + 1):
        cells = [cells[number - 1] for cells in near if number <= len(cells)]
        stated = [part.strip(")] ") for cell in cells for part in re.split(r"[(\[]", cell)]
        typed[f"unit_{number}"] = next((unit for part in stated if (unit := known_unit(part)) in UNIT_CHOICES and unit), "")
    return typed


def _stored(row: ColumnMapping) -> dict[str, str]:
    """Convert a stored mapping to the form's fields."""
    mapping = row.as_mapping
    typed = {"name": row.name, "unit_lines": str(mapping.unit_lines), "holds": mapping.holds, "time_format": mapping.time_format}
    typed |= {"zone": mapping.zone or "", "rate_hz": "" if mapping.rate_hz is None else f"{mapping.rate_hz:g}"}
    typed |= {"time_at": ("begin" if mapping.row_begins else "end") if mapping.holds == "steps" else "", "header": mapping.header}
    for c in mapping.columns:
        typed |= {f"role_{c.number}": c.role, f"unit_{c.number}": c.unit or "", f"side_{c.number}": c.side or ""}
        typed |= {f"channel_{c.number}": c.channel or ""}
    return typed


def _form_page(request: Request, table: WaitingTable, typed: dict[str, str], error: BetaloopError | None = None) -> HTMLResponse:
    lines = table.preview["lines"]
    if "header_line" not in typed:
        same = (line["number"] for line in lines if line["header"] == typed.get("header"))
        typed = typed | {"header_line": str(next(same, table.preview["header_line"]))}
    header: list[str] = next((line["cells"] for line in lines if str(line["number"]) == typed["header_line"]), [])
    page = render(
        request,
        "ingest/mapping.html",
        participant=table.participant,
        study=table.participant.site.study,
        file=table.file,
        why=problem_of(table.file),
        known=table.known,
        width=table.preview["width"],
        lines=lines,
        header=header,
        typed=typed,
        roles=[("", "not used"), *ROLE_NAMES.items()],
        holds=[("", "Choose"), *HOLDS_NAMES.items()],
        formats=[("", "Choose"), *TIME_FORMATS],
        units=UNIT_CHOICES,
        remarks=field_notes(error, dict.fromkeys(LABELS, "")),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)


def _list_page(
    request: Request, db: Session, study: Study, caller: Caller, error: BetaloopError | None = None, sent: int | None = None
) -> HTMLResponse:
    """Show the list; `sent` is the mapping whose form was refused."""
    rows = mappings_out(repository.versions(db, study.id), repository.present(db, study.id))
    page = render(
        request,
        "ingest/mappings.html",
        study=study,
        present=[m for m in rows if m.current],
        before=[m for m in rows if not m.current],
        role_names=ROLE_NAMES,
        holds_names=HOLDS_NAMES,
        formats=dict(TIME_FORMATS),
        removable={m.id for m in rows if service.may_remove(caller, study.id, m.created_by)},
        sent=sent,
        remarks=field_notes(error, {}),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
