"""The form that corrects a visit: date, note, and the cDBS amplitude of each hemisphere and program."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy.orm import Session

from app.platform.errors import Invalid
from app.platform.web.forms import parse
from app.platform.web.numbers import typed
from app.study import repository
from app.study.schemas import CdbsAmplitudeModel, VisitChange
from app.tables.participants import Hemisphere
from app.tables.visits import Visit

SIDES = tuple(side.value for side in Hemisphere)
PROGRAMS = range(4)
_PLAIN = {"date": "Date", "note": "Note"}


def texts(visit: Visit) -> dict[str, str]:
    """The visit as the form shows it."""
    fields = {"date": visit.date.isoformat() if visit.date else "", "note": visit.note or ""}
    fields |= {f"cdbs_{side}_{program}": "" for program in PROGRAMS for side in SIDES}
    return fields | {f"cdbs_{a.hemisphere}_{a.program}": typed(a.amplitude_ma, 10) for a in visit.cdbs_amplitudes}


def labels(fields: Mapping[str, str]) -> dict[str, str]:
    """What the form calls its fields."""
    return {name: _PLAIN.get(name) or _label(name) for name in fields}


def seen(values: Mapping[str, Any], present: Mapping[str, str]) -> dict[str, str]:
    """What the posted form had shown; a field of which it says nothing is held against what is stored now."""
    return {name: posted(values).get(f"seen_{name}", text) for name, text in present.items()}


def posted(values: Mapping[str, Any]) -> dict[str, str]:
    """The posted fields; browsers send line breaks as two characters."""
    return {str(name): str(value).replace("\r\n", "\n") for name, value in values.items()}


def amplitudes(typed: Mapping[str, str], sure: Collection[str] = ()) -> list[CdbsAmplitudeModel]:
    """The amplitudes that a form states, `sure` being the fields that a person confirmed. Raises Invalid, naming the field."""
    return [_amplitude(n, text, n in sure) for n, text in typed.items() if n.startswith("cdbs_") and text.strip()]


def asked_about(question: Mapping[str, Any]) -> str:
    """The field of the correction form that a question about an amplitude belongs to."""
    return f"cdbs_{question['hemisphere']}_{question['program']}"


def change(present: Mapping[str, str], changed: Mapping[str, str], reason: str, sure: Collection[str] = ()) -> VisitChange:
    """The change of a visit that the form asks for; `sure`: fields that a person confirmed.

    Raises:
        Invalid: no reason, or a field that cannot be read; names it.
    """
    if not reason:
        raise Invalid("A correction needs a reason.", "Say why the visit is corrected.")
    fields: dict[str, Any] = {name: changed[name] for name in _PLAIN if name in changed}
    draft = parse(VisitChange, fields | {"reason": reason}, _PLAIN)
    merged = {**present, **changed}
    if any(name.startswith("cdbs_") for name in changed):
        draft.cdbs_amplitudes = amplitudes(merged, sure)
    return draft


def last_editor(db: Session, visit: Visit) -> str:
    """Who changed the visit last."""
    return repository.last_editor(db, "visit", visit.id)


def _amplitude(name: str, text: str, sure: bool) -> CdbsAmplitudeModel:
    side, program = _place(name)
    values = {"hemisphere": side, "program": program, "amplitude_ma": text, "sure": "yes" if sure else "no"}
    try:
        return parse(CdbsAmplitudeModel, values, {"amplitude_ma": _label(name)})
    except Invalid as error:
        raise Invalid(error.detail, error.hint, errors=[e | {"name": name} for e in error.extra["errors"]]) from error


def _place(name: str) -> tuple[str, str]:
    _, side, *program = name.split("_")
    return side, program[0] if program else "0"


def _label(name: str) -> str:
    side, program = _place(name)
    return f"cDBS amplitude, {side}" + (f", program {program}" if program != "0" else "")
