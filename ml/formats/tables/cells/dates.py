"""Dates as people and spreadsheets write them: month names, day numbers of a spreadsheet, and the zone that a header states."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from ml.formats.tables.cells.numbers import column_name

_MONTHS = {name: i for i, name in enumerate(["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"], start=1)}
_LONG = ["january", "february", "march", "april", "may", "june", "july", "august", "september", "october", "november", "december"]
_MONTHS |= {name: i for i, name in enumerate(_LONG, start=1)} | {"sept": 9}
_CLOCK = r"[ T,]+(\d{1,2}):(\d{2})(?::(\d{2})(?:\.(\d{1,6}))?)?\s*([ap]m)?"
_DATE = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}", re.ASCII)
_DAY_FIRST = re.compile(r"(\d{1,2})\.?[ -]([a-z]{3,9})\.?,?[ -](\d{4})" + _CLOCK, re.ASCII | re.IGNORECASE)
_MONTH_FIRST = re.compile(r"([a-z]{3,9})\.? (\d{1,2}),? (\d{4})" + _CLOCK, re.ASCII | re.IGNORECASE)
_OFFSET = re.compile(r"(?:UTC|GMT)?\s*([+-])(\d{1,2})(?::?(\d{2}))?", re.ASCII | re.IGNORECASE)

SPREADSHEET_DAYS = (36_526.0, 73_050.0)
"""Day numbers of the years 2000 to 2099. No seconds of Unix time of a study are as small."""
_DAY_0 = datetime(1899, 12, 30)


class ChangedClocks(ValueError):
    """Raised for a time that a zone shows twice or never, in the night in which clocks are changed."""


def named_month(text: str) -> datetime | None:
    """Parse a date and time with an English month name, such as `05-Mar-2026 14:10:00`, without a zone; None for anything else."""
    plain = " ".join(text.split())  # some exports have narrow blanks
    found = _DAY_FIRST.fullmatch(plain)
    if found is not None:
        day, name, year, *clock = found.groups()
    elif (found := _MONTH_FIRST.fullmatch(plain)) is not None:
        name, day, year, *clock = found.groups()
    else:
        return None
    hour, half = int(clock[0]), (clock[4] or "").lower()
    if half:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + 12 * (half == "pm")
    try:
        part = int((clock[3] or "0").ljust(6, "0"))
        return datetime(int(year), _MONTHS[name.lower()], int(day), hour, int(clock[1]), int(clock[2] or 0), part)
    except (ValueError, KeyError):
        return None


def written_s(cell: str) -> float | None:
    """Read a date and time, in ISO 8601 or with the name of its month, as Unix time in s.

    One without a zone counts as UTC. None for anything else.
    """
    text = cell.strip()
    try:
        moment = datetime.fromisoformat(text) if _DATE.match(text) is not None else named_month(text)
        if moment is None:
            return None
        return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None


def spreadsheet_date(days: float) -> datetime | None:
    """Convert a spreadsheet's number of days since 30 December 1899 to a date without a zone, to the millisecond; None for no date."""
    if not SPREADSHEET_DAYS[0] <= days < SPREADSHEET_DAYS[1]:
        return None
    return _DAY_0 + timedelta(milliseconds=round(days * 86_400_000))


def zone_of_header(header: str) -> tzinfo | None:
    """Read the zone that a header has in brackets, such as `time (UTC+1)` or `time [Europe/Berlin]`; None where it has none."""
    return zone_named(column_name(header)[1] or "")


def zone_named(text: str) -> tzinfo | None:
    """Read a zone, as an offset from UTC or by its IANA name; None for anything else. Abbreviations such as EST have several meanings."""
    plain = text.strip()
    if plain.upper() in ("UTC", "GMT", "Z"):
        return UTC
    if (found := _OFFSET.fullmatch(plain)) is not None:
        offset = timedelta(hours=int(found[2]), minutes=int(found[3] or 0))
        return timezone(-offset if found[1] == "-" else offset) if offset <= timedelta(hours=14) else None
    if "/" not in plain:
        return None
    try:
        return ZoneInfo(plain)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None


def in_zone(moment: datetime, zone: tzinfo) -> datetime:
    """Give a moment without a zone that zone. Raises ChangedClocks where the zone shows it twice or never."""
    found = moment.replace(tzinfo=zone, fold=0)
    if found.utcoffset() != found.replace(fold=1).utcoffset():
        raise ChangedClocks(f"the clocks of {zone} show it twice or never")
    return found
