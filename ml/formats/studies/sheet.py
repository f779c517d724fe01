"""Sheet of a whole study: one row per session, as CSV, xlsx, or a REDCap export with its data dictionary. Which recording a row is of is
decided elsewhere (`app.ingest.study_import`)."""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, time, tzinfo
from typing import Any

from ml.formats.recording import UndecodableFile
from ml.formats.tables.cells.dates import ChangedClocks, in_zone, named_month
from ml.formats.tables.cells.numbers import MISSING, NotANumber, column_name, parse_number, shown
from ml.formats.tables.log_head import STATED_FIELDS
from ml.outcomes import OUTCOMES

ROLES: dict[str, tuple[str, ...]] = {
    "participant": ("participant", "subject", "patient", "code", "participant_code", "subject_id", "participant_id", "id"),
    "visit": ("visit", "visit_number", "visit_no"),
    "date": ("date", "visit_date", "day", "session_date"),
    "start": ("start", "session_start", "started_at", "start_time", "begin", "time"),
    "minutes": ("minutes", "duration_min", "length_min", "duration"),
    "controller": ("controller", "condition", "arm", "mode", "stimulation"),
    "policy": ("policy", "policy_name"),
    "hemisphere": ("hemisphere", "side"),
    "amplitude_ma": ("amplitude", "amplitude_ma", "cdbs_amplitude", "cdbs_amplitude_ma"),
    "file": ("file", "file_name", "filename", "recording"),
    "sha256": ("sha256", "file_sha256"),
    "session": ("session", "session_id", "session_no", "session_nr", "session_number", "run"),
    "medication_h": ("medication_h", "hours_since_dose", "hours_since_last_dose"),
    "last_dose": ("last_dose", "last_dose_at", "medication_time", "last_medication"),
    **{name: (name,) for name in STATED_FIELDS},
    "note": ("note", "notes", "comment", "comments", "remarks"),
    **{o.field: (o.field, o.key, o.column, column_name(o.label)[0]) for o in OUTCOMES},
}
"""Names of columns by role, as `column_name` normalises them."""

NUMBERS = frozenset({"visit", "minutes", "amplitude_ma", "medication_h", *(o.field for o in OUTCOMES)})
CONTROLLERS = {
    "cdbs": ("cdbs", "continuous", "continuous_dbs", "conventional", "conventional_dbs", "open_loop"),
    "no_dbs": ("no_dbs", "off", "no_stimulation", "dbs_off", "stimulation_off"),
    "random": ("random", "randomised", "randomized", "exploration"),
    "rl": ("rl", "reinforcement_learning"),
    "distilled": ("distilled", "student"),
    "other": ("other", "adaptive", "adbs", "threshold"),
}
DICTIONARY = ("Variable / Field Name", "Field Label", "Choices, Calculations, OR Slider Labels")
"""Columns of a REDCap data dictionary that are read. Source: REDCap's export."""

REDCAP = frozenset({"redcap_event_name", "redcap_repeat_instance", "redcap_repeat_instrument", "redcap_data_access_group"})
MOST_ROWS = 20_000
HINT = "Give the columns participant, visit and controller, and a start with its date, or the name of the file."


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetRow:
    """One session as the sheet states it; None where it states nothing.

    Attributes:
        line: of the sheet. day: of the visit. start: UTC. minutes: length.
        session: what the file calls it, where it holds several.
        outcomes: by field of `OUTCOMES`. last_dose: UTC. has_note: whether a note was given, which is not kept.
        design: of a random session, by field of `STATED_FIELDS`.
    """

    line: int
    participant: str
    visit: int
    controller: str
    day: date | None = None
    start: datetime | None = None
    minutes: float | None = None
    policy: str | None = None
    hemisphere: str | None = None
    amplitude_ma: float | None = None
    file: str | None = None
    sha256: str | None = None
    session: str | None = None
    medication_h: float | None = None
    last_dose: datetime | None = None
    design: Mapping[str, Any] = field(default_factory=dict)
    outcomes: Mapping[str, float] = field(default_factory=dict)
    has_note: bool = False


@dataclass(frozen=True, slots=True)
class Sheet:
    """A sheet as it was read: its rows, the rows that cannot be used with why, and the columns of no use."""

    rows: list[SheetRow]
    problems: list[tuple[int, str]]
    ignored: list[str]


def read_sheet(
    content: bytes, zone: tzinfo | None = None, dictionary: bytes | None = None, columns: Mapping[str, str] | None = None
) -> Sheet:
    """Read a sheet.

    Args:
        content: CSV in UTF-8, or an xlsx workbook, whose first sheet counts.
        zone: of times that state none; None refuses such rows.
        dictionary: a REDCap data dictionary, whose labels name the columns and whose choices name the codes.
        columns: header of the sheet by role, where the roles' own names do not find it.

    Raises:
        UndecodableFile: no sheet, a column that is needed is missing, or a stated column is not there.
    """
    cells = _workbook(content) if zipfile.is_zipfile(io.BytesIO(content)) else _text(content)
    header = next((i for i, row in enumerate(cells) if sum(bool(str(c).strip()) for c in row) > 1), None)
    if header is None:
        raise UndecodableFile("the sheet has no header", "line 1", HINT)
    names = [str(c).strip() for c in cells[header]]
    labels, choices = _dictionary(dictionary) if dictionary is not None else ({}, {})
    places = _places(names, labels, columns or {})
    if missing := [role for role in ("participant", "visit", "controller") if role not in places]:
        found = ", ".join(shown(n) for n in names[:20])
        raise UndecodableFile(f"the sheet has no column {' and no '.join(missing)}; found: {found}", f"line {header + 1}", HINT)
    rows: list[SheetRow] = []
    problems: list[tuple[int, str]] = []
    for line, row in enumerate(cells[header + 1 : header + 1 + MOST_ROWS], start=header + 2):
        given = {role: _decode(row[i], choices.get(names[i], {})) for role, i in places.items() if i < len(row)}
        given = {role: value for role, value in given.items() if str(value).strip().lower() not in MISSING}
        if not given:
            continue
        try:
            rows.append(_row(line, given, zone))
        except ValueError as error:
            problems.append((line, str(error)))
    if len(cells) > header + 1 + MOST_ROWS:
        problems.append((header + 1 + MOST_ROWS, f"more than {MOST_ROWS} rows; the rest was left out"))
    return Sheet(rows, problems, [n for i, n in enumerate(names) if n and i not in places.values()])


def _workbook(content: bytes) -> list[list[Any]]:
    """Read the first sheet of a workbook. Raises UndecodableFile."""
    from python_calamine import CalamineError, CalamineWorkbook  # a sheet is rare, and the library is not needed for anything else

    try:
        return CalamineWorkbook.from_filelike(io.BytesIO(content)).get_sheet_by_index(0).to_python(skip_empty_area=False)
    except (CalamineError, IndexError, zipfile.BadZipFile) as error:
        raise UndecodableFile("this is no workbook that can be read", "file", "Save it as xlsx or as CSV (UTF-8).") from error


def _text(content: bytes) -> list[list[Any]]:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UndecodableFile("the sheet is not UTF-8 text", f"byte {error.start}", "Save it as CSV (UTF-8), or as xlsx.") from error
    first = text.split("\n", 1)[0]
    delimiter = max(",;\t", key=first.count)
    return [list(row) for row in csv.reader(io.StringIO(text), delimiter=delimiter)]


def _dictionary(content: bytes) -> tuple[dict[str, str], dict[str, dict[str, str]]]:
    """Read labels and choices by variable. Raises UndecodableFile for a table that is no data dictionary."""
    rows = list(csv.DictReader(io.StringIO(content.decode("utf-8-sig", errors="replace"))))
    if not rows or any(name not in rows[0] for name in DICTIONARY):
        hint = "Export it in REDCap under Data Dictionary, as CSV."
        raise UndecodableFile("this is no REDCap data dictionary", "line 1", hint)
    variable, label, options = DICTIONARY
    labels = {row[variable]: row[label] for row in rows}
    choices = {}
    for row in rows:
        pairs = [p.split(",", 1) for p in (row[options] or "").split("|") if "," in p]
        choices[row[variable]] = {code.strip(): text.strip() for code, text in pairs}
    return labels, choices


def _places(names: Sequence[str], labels: Mapping[str, str], columns: Mapping[str, str]) -> dict[str, int]:
    """Find the column of each role: the stated one, else by its name, else by its label. Raises UndecodableFile."""
    places: dict[str, int] = {}
    for role, header in columns.items():
        if role not in ROLES or header not in names:
            what = f"no column {shown(header)} in the sheet" if role in ROLES else f"{shown(role)} is no meaning of a column"
            raise UndecodableFile(what, "columns", f"Meanings are {', '.join(ROLES)}.")
        places[role] = names.index(header)
    for texts in (names, [labels.get(n, "") for n in names]):
        for i, text in enumerate(texts):
            key, unit = column_name(text)
            for role, known in ROLES.items():
                if role not in places and i not in places.values() and (key in known or (unit and f"{key}_{unit.lower()}" in known)):
                    places[role] = i
    if REDCAP & set(names):
        if "participant" not in places and "record_id" in names:
            places["participant"] = names.index("record_id")
        if "visit" not in places and "redcap_event_name" in names:
            places["visit"] = names.index("redcap_event_name")
    return places


def _decode(value: Any, choices: Mapping[str, str]) -> Any:
    return choices.get(str(value).strip(), value) if choices else value


def _row(line: int, cells: Mapping[str, Any], zone: tzinfo | None) -> SheetRow:
    """Read one row. Raises ValueError, naming the column."""
    for role in ("participant", "visit", "controller"):
        if role not in cells:
            raise ValueError(f"no {role}")
    day = _day(cells["date"]) if "date" in cells else None
    numbers = {role: _number(role, cells[role]) for role in NUMBERS & cells.keys()}
    visit = numbers["visit"]
    if visit != int(visit) or visit < 1:
        raise ValueError(f"visit {visit:g} is no number of a visit")
    texts = {role: str(cells[role]).strip() for role in ("policy", "file", "sha256") if role in cells}
    return SheetRow(
        line=line,
        participant=_code(cells["participant"]),
        visit=int(visit),
        controller=_controller(str(cells["controller"])),
        day=day or (cells["start"].date() if isinstance(cells.get("start"), datetime) else None),
        start=_moment("start", cells["start"], day, zone) if "start" in cells else None,
        last_dose=_moment("last_dose", cells["last_dose"], day, zone) if "last_dose" in cells else None,
        hemisphere=_side(str(cells["hemisphere"])) if "hemisphere" in cells else None,
        outcomes={o.field: numbers[o.field] for o in OUTCOMES if o.field in numbers},
        has_note="note" in cells,
        minutes=numbers.get("minutes"),
        amplitude_ma=numbers.get("amplitude_ma"),
        medication_h=numbers.get("medication_h"),
        policy=texts.get("policy"),
        file=texts.get("file"),
        sha256=texts.get("sha256"),
        session=_code(cells["session"]) if "session" in cells else None,
        design={name: _design_field(name, cells[name]) for name in STATED_FIELDS if name in cells},
    )


def _code(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).strip()


def _number(role: str, value: Any) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    text = str(value).strip()
    if role == "visit" and (found := re.findall(r"\d+", text)) and not re.fullmatch(r"[\d.,]+", text):
        text = found[0]  # `visit_2_arm_1` of REDCap
    try:
        number = parse_number(text, "," if "," in text and "." not in text else ".")
    except NotANumber:
        number = None
    if number is None:
        raise ValueError(f"{role}: {shown(text)} is no number")
    return number


def _controller(text: str) -> str:
    key = column_name(text)[0]
    found = next((name for name, words in CONTROLLERS.items() if key in words), None)
    if found is None:
        raise ValueError(f"controller {shown(text)} is none of {', '.join(CONTROLLERS)}")
    return found


def _side(text: str) -> str:
    found = {"left": "left", "l": "left", "right": "right", "r": "right"}.get(text.strip().lower())
    if found is None:
        raise ValueError(f"hemisphere {shown(text)} is neither left nor right")
    return found


def _design_field(name: str, value: Any) -> Any:
    """Read a field of a design: a number, a JSON object or a name. Raises ValueError."""
    if isinstance(value, int | float):
        return float(value)
    text = str(value).strip()
    if text.startswith("{"):
        try:
            return json.loads(text)
        except ValueError:
            raise ValueError(f"{name} is no JSON object") from None
    try:
        return parse_number(text)
    except NotANumber:
        return text


def _day(value: Any) -> date:
    if isinstance(value, datetime):
        return value.date()
    if isinstance(value, date):
        return value
    text = str(value).strip()
    try:
        return date.fromisoformat(text[:10]) if text[:4].isdigit() else _with_month_name(text).date()
    except ValueError:
        raise ValueError(f"date {shown(text)} is not written as 2026-03-31 or 31 Mar 2026") from None


def _with_month_name(text: str) -> datetime:
    found = named_month(text)
    if found is None:
        raise ValueError(text)
    return found


def _moment(role: str, value: Any, day: date | None, zone: tzinfo | None) -> datetime:
    """Read a moment in UTC: with its date, or a time of the row's day. Raises ValueError for one without a zone where none is stated."""
    found: datetime
    if isinstance(value, datetime):
        found = value
    elif isinstance(value, time) or (isinstance(value, str) and re.fullmatch(r"\d{1,2}:\d{2}(:\d{2})?", value.strip())):
        if day is None:
            raise ValueError(f"{role} {value} has no date, and the row has none")
        clock = value if isinstance(value, time) else time.fromisoformat(value.strip().rjust(5 if value.count(":") == 1 else 8, "0"))
        found = datetime.combine(day, clock)
    else:
        text = str(value).strip()
        try:
            found = datetime.fromisoformat(text)
        except ValueError:
            try:
                found = _with_month_name(text)
            except ValueError:
                raise ValueError(f"{role} {shown(text)} is no date and time, as in 2026-03-31 10:05") from None
    if found.tzinfo is not None:
        return found.astimezone(UTC)
    if zone is None:
        raise ValueError(f"{role} {found:%Y-%m-%d %H:%M} has no zone: state the clinic's zone")
    try:
        return in_zone(found, zone).astimezone(UTC)
    except ChangedClocks:
        raise ValueError(f"{role} {found:%Y-%m-%d %H:%M} is a time that the clocks of its zone show twice or never") from None


def write_sheet(rows: Sequence[Mapping[str, Any]]) -> str:
    """Write rows as CSV that `read_sheet` reads; nothing where a value is None, JSON where it is an object."""
    out = io.StringIO()
    names = list(dict.fromkeys(name for row in rows for name in row)) or ["participant", "visit", "controller"]
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        writer.writerow(["" if (v := row.get(n)) is None else json.dumps(v) if isinstance(v, Mapping) else v for n in names])
    return out.getvalue()
