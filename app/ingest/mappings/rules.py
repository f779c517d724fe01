"""Rules that make a column mapping unambiguous: every breach is reported with its field."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any
from zoneinfo import available_timezones

from app.ingest.mappings.schemas import MappedColumnIn, MappingIn
from app.platform.errors import Invalid
from ml.formats import OUTCOME_TABLES
from ml.formats.tables.cells.numbers import unit_name
from ml.formats.tables.mapping.model import AMPLITUDES, SIGNALS, UNITS, WRITTEN, MappedColumn, TableMapping
from ml.formats.tables.mapping.times import is_absolute

ROLE_NAMES = {
    "time": "Time",
    "beta": "Beta, amplitude",
    "beta_power": "Beta, power",
    "lfp": "LFP, samples",
    "amplitude_ma": "Stimulation, current",
    "amplitude_fraction": "Stimulation, share of cDBS",
    "tremor_unknown": "Tremor unknown, share",
    "tremor_none": "No tremor, share",
    "tremor_slight": "Slight tremor, share",
    "tremor_mild": "Mild tremor, share",
    "tremor_moderate": "Moderate tremor, share",
    "tremor_strong": "Strong tremor, share",
    "tremor_class": "Class of tremor, a word",
    "hand": "Hand, L or R",
}
HOLDS_NAMES = {"steps": "steps of beta", "lfp": "samples of LFP", **{one.kind: one.holds for one in OUTCOME_TABLES}}
ALLOWED: dict[str, tuple[str, ...]] = {
    "steps": ("time", "beta", "beta_power", *AMPLITUDES),
    "lfp": ("time", "lfp", *AMPLITUDES),
    **{one.kind: ("time", *one.roles) for one in OUTCOME_TABLES},
}
_CHANNEL = re.compile(r"(?=.*\d)[0-9A-Ea-e+/-]{1,20}")
_NEEDED_SHARES = ("tremor_none", "tremor_slight", "tremor_mild", "tremor_moderate", "tremor_strong")
_SHARES = ("tremor_unknown", *_NEEDED_SHARES)


def mapping_of(wanted: MappingIn, preview: dict[str, Any]) -> TableMapping:
    """Build a mapping from what a person stated, and the preview that they saw.

    Raises:
        Invalid: names each field that is wrong and why; the document's `errors` holds them.
    """
    line = next((ln for ln in preview["lines"] if ln["number"] == wanted.header_line and ln["header"]), None)
    errors: list[tuple[str, str]] = []
    if line is None:
        errors.append(("Line of names", f"line {wanted.header_line} is not one of the preview that has all columns"))
    errors += [*_times(wanted), *_columns(wanted, int(preview["width"])), *_sides(wanted), *_whole(wanted)]
    if errors or line is None:
        told = [{"where": where, "what": what} for where, what in errors]
        raise Invalid("The table cannot be read as stated.", "Correct the fields; nothing was changed.", errors=told)
    columns = tuple(
        MappedColumn(c.number, c.role, unit_name(c.unit) if c.unit else None, c.side.value if c.side else None, c.channel or None)
        for c in sorted(wanted.columns, key=lambda c: c.number)
    )
    return TableMapping(
        header=line["header"],
        width=int(preview["width"]),
        unit_lines=wanted.unit_lines,
        holds=wanted.holds,
        time_format=wanted.time_format,
        zone=wanted.zone or None,
        rate_hz=wanted.rate_hz,
        row_begins=wanted.time_at == "begin",
        columns=columns,
    )


def _times(wanted: MappingIn) -> list[tuple[str, str]]:
    errors = []
    if wanted.time_format in WRITTEN and not wanted.zone:
        errors.append(("Zone", "dates need the zone in which they are written, e.g. Europe/Berlin or UTC"))
    elif wanted.zone and wanted.time_format not in WRITTEN:
        errors.append(("Zone", "only written dates have a zone: leave it empty"))
    elif wanted.zone and wanted.zone not in available_timezones():
        errors.append(("Zone", "it is no zone of the IANA list, such as Europe/Berlin, America/Los_Angeles or UTC"))
    if (wanted.time_format == "samples") != (wanted.rate_hz is not None):
        said = "numbers of samples need the rate" if wanted.rate_hz is None else "only numbers of samples have a rate: leave it empty"
        errors.append(("Rate", said))
    if (wanted.holds == "steps") != (wanted.time_at is not None):
        said = (
            "say whether a step's time stands at its begin or its end"
            if wanted.time_at is None
            else "only steps have a begin and an end: leave it empty"
        )
        errors.append(("A step's time", said))
    return errors


def _columns(wanted: MappingIn, width: int) -> list[tuple[str, str]]:
    errors = []
    numbers = Counter(c.number for c in wanted.columns)
    errors += [(_where(n), "it is named twice") for n, count in numbers.items() if count > 1]
    for c in wanted.columns:
        where = _where(c.number)
        if c.number > width:
            errors.append((where, f"the table has {width} columns"))
        if c.role not in ALLOWED[wanted.holds]:
            errors.append((where, f"a table of {HOLDS_NAMES[wanted.holds]} has no column '{ROLE_NAMES[c.role]}'"))
        errors += [(where, said) for said in (_unit(c), _channel(c)) if said]
    return errors


def _unit(column: MappedColumnIn) -> str | None:
    units = UNITS.get(column.role)
    if units is None:
        return f"'{ROLE_NAMES[column.role]}' has no unit: leave it empty" if column.unit else None
    if not column.unit:
        return f"state the unit of '{ROLE_NAMES[column.role]}': {', '.join(units)}"
    if unit_name(column.unit) not in units:
        return f"'{ROLE_NAMES[column.role]}' is in one of {', '.join(units)}"
    return None


def _channel(column: MappedColumnIn) -> str | None:
    if (column.side or column.channel) and column.role not in (*SIGNALS, *AMPLITUDES):
        return f"'{ROLE_NAMES[column.role]}' has no side and no channel: leave them empty"
    if column.channel and column.role not in SIGNALS:
        return "only beta and LFP have a channel: leave it empty"
    if column.channel and _CHANNEL.fullmatch(column.channel) is None:
        return "write the channel as contacts, such as 0-2, E1-E3 or 1A"
    return None


def _sides(wanted: MappingIn) -> list[tuple[str, str]]:
    """Check that sides are stated of all signals and amplitudes or of none, and that no side has two equal ones."""
    errors = []
    both = [c for c in wanted.columns if c.role in (*SIGNALS, *AMPLITUDES)]
    if any(c.side for c in both):
        errors += [(_where(c.number), "state the side, as of the others") for c in both if not c.side]
    amplitudes = Counter((c.side, c.role) for c in both if c.role in AMPLITUDES)
    signals = Counter((c.side, c.channel or "") for c in both if c.role in SIGNALS)
    for c in both:
        if c.role in AMPLITUDES and amplitudes[c.side, c.role] > 1:
            errors.append((_where(c.number), "one side has one such amplitude: state the sides, or leave one out"))
        if c.role in SIGNALS and signals[c.side, c.channel or ""] > 1:
            errors.append((_where(c.number), "state side and channel, so that no two signals have the same"))
    return errors


def _whole(wanted: MappingIn) -> list[tuple[str, str]]:
    """Check that the table has all that it needs."""
    roles = [c.role for c in wanted.columns]
    errors = []
    if (times := roles.count("time")) != 1:
        errors.append(("Columns", f"one column is the time, not {times}"))
    if wanted.holds in ("steps", "lfp") and not any(r in SIGNALS for r in roles):
        errors.append(("Columns", f"a table of {HOLDS_NAMES[wanted.holds]} needs a column of {'LFP' if wanted.holds == 'lfp' else 'beta'}"))
    if wanted.holds == "steps" and not any(r in AMPLITUDES for r in roles):
        errors.append(("Columns", "a table of steps needs a column of the stimulation's amplitude"))
    if wanted.holds == "tremor":
        missing = [ROLE_NAMES[r] for r in _NEEDED_SHARES if r not in roles]
        if "tremor_class" in roles and any(r in _SHARES for r in roles):
            errors.append(("Columns", "tremor is told by shares or by a class, not by both"))
        elif "tremor_class" not in roles and missing:
            errors.append(("Columns", f"tremor needs a column of its class, or shares of every class; missing: {', '.join(missing)}"))
        if not is_absolute(wanted.time_format):
            errors.append(("Format of times", "minutes of tremor find their session by the clock: they need Unix times or dates"))
    repeated = Counter(r for r in roles if any(r in one.roles for one in OUTCOME_TABLES))
    errors += [("Columns", f"'{ROLE_NAMES[r]}' is named twice") for r, count in repeated.items() if count > 1]
    return errors


def _where(number: int) -> str:
    return f"Column {number}"
