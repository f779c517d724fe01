"""Values that may be asked about, by what they stand in; and what each is at the moment."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from app.study.characteristics.schemas import CharacteristicsFields
from app.study.characteristics.service import fields_of
from app.study.settings.schemas import SettingsFields
from app.tables.adverse_events import AdverseEvent
from app.tables.data_queries import Subject
from app.tables.participants import Hemisphere, Participant
from app.tables.sessions import StudySession
from app.tables.visits import Dose, Visit
from ml.outcomes import FIELDS as OUTCOME_FIELDS

OTHER = "other"
"""Anything else, said in the text."""
FIELDS: Mapping[Subject, tuple[str, ...]] = {
    Subject.SESSION: (*OUTCOME_FIELDS, "controller", "started_at", "hemisphere", "medication_h", "stopped_reason", OTHER),
    Subject.UPLOAD: ("file", OTHER),
    Subject.VISIT: ("date", "cdbs_left", "cdbs_right", "note", OTHER),
    Subject.DOSE: ("drug", "mg", "taken_at", OTHER),
    Subject.EVENT: ("kind", "severity", "serious", "occurred_at", "note", OTHER),
    Subject.SETTINGS: (*SettingsFields.model_fields, OTHER),
    Subject.CHARACTERISTICS: (*CharacteristicsFields.model_fields, OTHER),
}
NOT_KEPT = frozenset({"controller", "file", OTHER})
"""Of these no value is kept with an entry: controllers are told by the blinding gate alone, and the others are not one value."""

Found = StudySession | Visit | Dose | AdverseEvent | Participant | None


def value_of(subject: Subject, field: str, found: Found) -> str | None:
    """A value as it stands now, as text; None where there is none, where it is not kept, and of a dose that was taken back.

    Args:
        found: the row that holds it; of settings and characteristics the participant.
    """
    if found is None or field in NOT_KEPT:
        return None
    value = _READ[subject](found, field)
    if value is None or value == "":
        return None
    return value if isinstance(value, str) else json.dumps(value) if isinstance(value, list | dict | bool) else str(value)


def _of_session(session: Any, field: str) -> Any:
    return getattr(session.qoc, field, None) if field in OUTCOME_FIELDS else getattr(session, field)


def _of_visit(visit: Any, field: str) -> Any:
    side = {"cdbs_left": Hemisphere.LEFT, "cdbs_right": Hemisphere.RIGHT}.get(field)
    if side is None:
        return getattr(visit, field)
    stated = sorted((a.program, a.amplitude_ma) for a in visit.cdbs_amplitudes if a.hemisphere == side)
    return ", ".join(f"{ma:g} mA" + (f" (program {program})" if program else "") for program, ma in stated)


def _of_event(event: Any, field: str) -> Any:
    return event.occurred_at if field == "occurred_at" else getattr(event.now, field)


def _of_characteristics(participant: Any, field: str) -> Any:
    return fields_of(participant.current_characteristics).model_dump(mode="json")[field]


_READ: Mapping[Subject, Callable[[Any, str], Any]] = {
    Subject.SESSION: _of_session,
    Subject.VISIT: _of_visit,
    Subject.DOSE: getattr,
    Subject.EVENT: _of_event,
    Subject.SETTINGS: lambda participant, field: getattr(participant.current_settings, field),
    Subject.CHARACTERISTICS: _of_characteristics,
}
