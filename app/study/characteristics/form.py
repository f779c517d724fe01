"""The form of characteristics: fixed rows of fields for leads and doses, and what a posted form says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from app.platform.errors import Invalid
from app.platform.web.forms import parse
from app.study.characteristics.schemas import MOST_DOSES, MOST_LEADS, CharacteristicsFields, Lead, PlannedDose, Symptom

LEAD_LABELS = {"hemisphere": "Side", "target": "Target", "model": "Type", "sensing": "Sensing", "stimulating": "Stimulating"}
DOSE_LABELS = {"drug": "Drug", "mg": "Dose", "at": "At"}


def texts(known: CharacteristicsFields) -> dict[str, str]:
    """Every field of the form by its name: `lead1_target`, `dose2_mg`, `symptom_tremor`, `hand`."""
    leads = [lead.model_dump(mode="json") for lead in known.leads]
    doses = [d.model_dump(mode="json") | {"mg": f"{d.mg:g}"} for d in known.medication]
    found = {"hand": known.hand or ""} | {f"symptom_{s}": "yes" if s in known.symptoms else "" for s in Symptom}
    for name, labels, rows, most in (("lead", LEAD_LABELS, leads, MOST_LEADS), ("dose", DOSE_LABELS, doses, MOST_DOSES)):
        for i in range(most):
            row: Mapping[str, Any] = rows[i] if i < len(rows) else {}
            found |= {f"{name}{i + 1}_{field}": str(row.get(field, "")) for field in labels}
    return found


def posted(values: Mapping[str, Any]) -> dict[str, str]:
    """A posted form as `texts` names its fields; a box that is not ticked is not sent."""
    return {name: str(values.get(name, "")).strip() for name in texts(CharacteristicsFields())}


def shown_rows(typed: Mapping[str, str], name: str) -> int:
    """Rows of leads (`lead`) or doses (`dose`) that stand open: up to the last one that says something, at least one."""
    labels, most = (LEAD_LABELS, MOST_LEADS) if name == "lead" else (DOSE_LABELS, MOST_DOSES)
    return max((i for i, _ in _rows(typed, name, labels, most)), default=1)


def characteristics(typed: Mapping[str, str]) -> CharacteristicsFields:
    """What a form says; an empty row says nothing.

    Raises:
        Invalid: names the row and the field that cannot be read.
    """
    leads = [parse(Lead, row, *_numbered("Lead", i, LEAD_LABELS)) for i, row in _rows(typed, "lead", LEAD_LABELS, MOST_LEADS)]
    planned = _rows(typed, "dose", DOSE_LABELS, MOST_DOSES)
    doses = [parse(PlannedDose, row, *_numbered("Dose", i, DOSE_LABELS)) for i, row in planned]
    for k, (i, _) in enumerate(planned):
        if (doses[k].drug, doses[k].at) in [(d.drug, d.at) for d in doses[:k]]:
            raise Invalid("The same drug stands twice at one time in the schedule.", "Give both together in one row.", field=f"dose{i}_at")
    symptoms = [s for s in Symptom if typed[f"symptom_{s}"]]
    hand = parse(CharacteristicsFields, {"hand": typed["hand"]}, {"hand": "Hand of the grasp test"}).hand
    return CharacteristicsFields(leads=leads, symptoms=symptoms, hand=hand, medication=doses)


def _rows(typed: Mapping[str, str], name: str, labels: Mapping[str, str], most: int) -> list[tuple[int, dict[str, str]]]:
    rows = [(i + 1, {field: typed[f"{name}{i + 1}_{field}"] for field in labels}) for i in range(most)]
    return [(i, row) for i, row in rows if any(row.values())]


def _numbered(what: str, number: int, labels: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """Labels and names of the fields of a row."""
    names = {field: f"{what.lower()}{number}_{field}" for field in labels}
    return {field: f"{what} {number}, {label.lower()}" for field, label in labels.items()}, names
