"""HTML page of a participant's characteristics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.schemas import problems
from app.platform.web.templates import render
from app.study import characteristics as characteristics_rules
from app.study.access import may
from app.study.characteristics import (
    MOST_DOSES,
    MOST_LEADS,
    SYMPTOMS,
    TARGETS,
    CharacteristicsChange,
    CharacteristicsFields,
    CharacteristicsOut,
    Lead,
    PlannedDose,
    Symptom,
    characteristics_words,
)
from app.study.deps import CurrentParticipant
from app.study.doses import DRUG_NAMES
from app.study.outcomes import hand
from app.study.settings_form import history_of, reason_of
from app.tables.participants import Participant

# The form of characteristics: fixed rows of fields for leads and doses, and what a posted form says.

LEAD_LABELS = {"hemisphere": "Side", "target": "Target", "model": "Type", "sensing": "Sensing", "stimulating": "Stimulating"}
DOSE_LABELS = {"drug": "Drug", "mg": "Dose", "at": "At"}


def texts(known: CharacteristicsFields) -> dict[str, str]:
    """Write every field of the form by its name: `lead1_target`, `dose2_mg`, `symptom_tremor`, `hand`."""
    leads = [lead.model_dump(mode="json") for lead in known.leads]
    doses = [d.model_dump(mode="json") | {"mg": f"{d.mg:g}"} for d in known.medication]
    found = {"hand": known.hand or ""} | {f"symptom_{s}": "yes" if s in known.symptoms else "" for s in Symptom}
    for name, labels, rows, most in (("lead", LEAD_LABELS, leads, MOST_LEADS), ("dose", DOSE_LABELS, doses, MOST_DOSES)):
        for i in range(most):
            row: Mapping[str, Any] = rows[i] if i < len(rows) else {}
            found |= {f"{name}{i + 1}_{field}": str(row.get(field, "")) for field in labels}
    return found


def posted(values: Mapping[str, Any]) -> dict[str, str]:
    """Read a posted form as `texts` names its fields; a box that is not ticked is not sent."""
    return {name: str(values.get(name, "")).strip() for name in texts(CharacteristicsFields())}


def shown_rows(typed: Mapping[str, str], name: str) -> int:
    """Count the rows of leads (`lead`) or doses (`dose`) that are open: up to the last one with content, at least one."""
    labels, most = (LEAD_LABELS, MOST_LEADS) if name == "lead" else (DOSE_LABELS, MOST_DOSES)
    return max((i for i, _ in _rows(typed, name, labels, most)), default=1)


def characteristics(typed: Mapping[str, str]) -> CharacteristicsFields:
    """Read a form; an empty row states nothing.

    Raises:
        Invalid: names the row and the field that cannot be read.
    """
    leads = [parse(Lead, row, *_numbered("Lead", i, LEAD_LABELS)) for i, row in _rows(typed, "lead", LEAD_LABELS, MOST_LEADS)]
    planned = _rows(typed, "dose", DOSE_LABELS, MOST_DOSES)
    doses = [parse(PlannedDose, row, *_numbered("Dose", i, DOSE_LABELS)) for i, row in planned]
    for k, (i, _) in enumerate(planned):
        if (doses[k].drug, doses[k].at) in [(d.drug, d.at) for d in doses[:k]]:
            raise Invalid(
                "The same drug is listed twice at one time in the schedule.", "Give both together in one row.", field=f"dose{i}_at"
            )
    symptoms = [s for s in Symptom if typed[f"symptom_{s}"]]
    hand = parse(CharacteristicsFields, {"hand": typed["hand"]}, {"hand": "Hand of the grasp test"}).hand
    return CharacteristicsFields(leads=leads, symptoms=symptoms, hand=hand, medication=doses)


def _rows(typed: Mapping[str, str], name: str, labels: Mapping[str, str], most: int) -> list[tuple[int, dict[str, str]]]:
    rows = [(i + 1, {field: typed[f"{name}{i + 1}_{field}"] for field in labels}) for i in range(most)]
    return [(i, row) for i, row in rows if any(row.values())]


def _numbered(what: str, number: int, labels: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return labels and names of the fields of a row."""
    names = {field: f"{what.lower()}{number}_{field}" for field in labels}
    return {field: f"{what} {number}, {label.lower()}" for field, label in labels.items()}, names


# REST routes of characteristics.

api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@api.get("/participants/{code}/characteristics")
def list_characteristics(participant: CurrentParticipant) -> list[CharacteristicsOut]:
    """List all versions of a participant's characteristics, oldest first; the last one applies."""
    return [CharacteristicsOut.model_validate(row) for row in participant.characteristics]


@api.put("/participants/{code}/characteristics", responses=problems(409))
def change_characteristics(
    participant: CurrentParticipant, change: CharacteristicsChange, db: Db, caller: CurrentCaller
) -> CharacteristicsOut:
    """State characteristics as a whole: a new version, or the present one where nothing differs."""
    row = hand.change_characteristics(db, participant, change.version, change.characteristics, change.reason, caller)
    return CharacteristicsOut.model_validate(row)


pages = APIRouter()


@pages.get("/participants/{code}/characteristics")
def characteristics_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show leads, symptoms, hand and medication of a participant, and the versions before."""
    return _page(request, db, participant, caller, texts(characteristics_rules.fields_of(participant.current_characteristics)))


@pages.post("/participants/{code}/characteristics")
def change_characteristics_by_form(
    request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues
) -> Response:
    """Make a new version of what the form says."""
    typed, before = posted(values), len(participant.characteristics)
    try:
        wanted, seen = characteristics(typed), str(values.get("version", ""))
        if not seen.isdecimal():
            raise Invalid("The form does not say which version it showed.", "Load the page again.")
        hand.change_characteristics(db, participant, int(seen), wanted, reason_of(values) or "", caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, participant, caller, typed, error, reason_of(values))
    changed = len(participant.characteristics) != before
    return RedirectResponse(f"/participants/{participant.code}/characteristics?done={'changed' if changed else 'same'}", 303)


def _page(
    request: Request,
    db: Session,
    participant: Participant,
    caller: Caller,
    values: dict[str, str],
    error: BetaloopError | None = None,
    reason: str | None = None,
) -> HTMLResponse:
    current = participant.current_characteristics
    suggested = characteristics_rules.suggested_hand(db, participant)
    page = render(
        request,
        "study/characteristics.html",
        participant=participant,
        current=current,
        values=values,
        reason=reason,
        symptoms=SYMPTOMS,
        targets=TARGETS,
        drugs=DRUG_NAMES,
        leads=range(1, MOST_LEADS + 1),
        doses=range(1, MOST_DOSES + 1),
        shown_leads=shown_rows(values, "lead"),
        shown_doses=shown_rows(values, "dose"),
        suggested=suggested,
        same_side=bool(current and current.hand and suggested and current.hand != suggested),
        history=history_of(
            [(row, characteristics_words(characteristics_rules.fields_of(row))) for row in participant.characteristics], first_tells=True
        ),
        may_write=may(caller, can.WRITE_STUDY, participant),
        remarks=field_notes(error, values),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
