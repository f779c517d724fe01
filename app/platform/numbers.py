"""Formats of numbers, lengths of time, sizes and dates on pages: the filters of the templates, and for words that Python makes."""

from __future__ import annotations

import math
from datetime import date, datetime

ROUNDING = 1e-12
"""A number nearer to 0 than this is what rounding left of 0."""
_RAISED = str.maketrans("0123456789", "\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079")


def number(value: float | None, digits: int = 3) -> str:
    """Format a number for people: significant digits, an em dash where there is none."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "—"
    if abs(value) < ROUNDING:
        return "0"
    if abs(value) < 0.5e-6:  # six decimals would show nothing but a sign
        return stated(value, digits)
    if abs(value) >= 10**digits:
        return f"{value:,.0f}".replace(",", "\u202f").replace("-", "\u2212")
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(decimals, 6)}f}".replace("-", "\u2212")


def fixed(value: float | None, decimals: int = 1) -> str:
    """Format a number with a fixed count of decimals; what rounds to nothing has no sign."""
    return "—" if value is None or math.isnan(value) else f"{value:z.{decimals}f}".replace("-", "\u2212")


def stated(value: float | None, digits: int = 6) -> str:
    """Format a number that a person stated or a device has, in as few digits as it needs: 2.5 mA stays 2.5, 20 min stay 20.

    Args:
        value: the number; an em dash where there is none. digits: significant ones at most.
    """
    if value is None or math.isnan(value):
        return "\u2014"
    if abs(value) >= 10**digits:
        return number(value, digits)  # in digits: 1.2e+03 is unreadable
    shown, _, power = f"{value:z.{digits}g}".partition("e")
    return (f"{shown}\u00d710\u207b{power.lstrip('-0').translate(_RAISED)}" if power else shown).replace("-", "\u2212")


def ma(value: float | None) -> str:
    """Format an amplitude in mA for people: as it was stated, to four decimals; what was computed to hundredths.

    So a limit is printed in full, and no amplitude that keeps a limit of whole hundredths is printed beyond it.
    """
    if value is None or math.isnan(value):
        return "\u2014"
    exact = round(value, 4)
    return stated(exact if abs(exact - value) < 1e-9 else round(value, 2))


def whole(value: float) -> int:
    """Round to the nearest whole number, to count with."""
    return round(value)


def rate(value: float) -> str:
    """Format a learning rate as people write it: 3e-4."""
    return f"{value:.0e}".replace("e-0", "e-")


def place(value: float) -> str:
    """Format a coordinate of a drawing."""
    return f"{value:.2f}"


def typed(value: float | None, digits: int = 4) -> str:
    """Format a number for a form's field: so many significant digits, nothing where there is none."""
    return "" if value is None else f"{value:.{digits}g}"


def hover(axis: str = "y", digits: int = 3) -> str:
    """Write the part of a chart's hover text that shows a value of the point in significant digits; plotly.js fills it in.

    Args:
        axis: `x`, `y` or `customdata`. digits: significant ones at most; no exponent is shown.
    """
    return f"%{{{axis}:,.{digits}~r}}"


def p_text(p: float | None) -> str:
    """Format a p-value for people, without the zero before its point; one that rounds to nothing is shown as below .001."""
    if p is None or math.isnan(p):
        return "\u2014"
    if p < 0.001:
        return "< .001"
    return "1" if p > 0.9995 else f"{p:.3f}".removeprefix("0")


def minutes(seconds: float | None) -> str:
    """Format a length of time for people: 10 min 20 s."""
    if seconds is None:
        return "—"
    whole = round(seconds)
    return f"{whole // 60} min" + (f" {whole % 60} s" if whole % 60 else "") if whole >= 60 else f"{whole} s"


def elapsed_time(seconds: float) -> str:
    """Format a time since the start of a session, in s, as minutes and seconds: 3:05."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def minutes_left(seconds: float) -> str:
    """Format a remaining time for people, no finer than it can be known."""
    if seconds < 60:
        return "less than a minute left"
    return f"about {math.ceil(seconds / 60)} min left" if seconds <= 7200 else f"about {seconds / 3600:.0f} h left"


def time_left(seconds: float | None) -> str:
    """Describe the remaining time of a job in words, also where it is unknown: on pages, in events and in the terminal."""
    return "time left not known yet" if seconds is None else minutes_left(seconds)


def size(value: int) -> str:
    """Format a number of bytes for people."""
    if value < 1024:
        return f"{value} B"
    amount, unit = float(value), "B"
    for larger in ("KiB", "MiB", "GiB"):
        if amount >= 1024:
            amount, unit = amount / 1024, larger
    return f"{stated(amount, 3)} {unit}"


def when(value: datetime | date | None) -> str:
    """Format a date, or a time to the minute (UTC)."""
    if value is None:
        return "—"
    return value.strftime("%Y-%m-%d %H:%M UTC") if isinstance(value, datetime) else value.isoformat()


def counted(number: float, one: str, many: str = "") -> str:
    """Write a number with its noun.

    Args:
        number: how many, to six digits. one: the noun of one. many: of several; `one` with an s where it is empty.
    """
    shown = f"{number:g}" if isinstance(number, float) else str(number)
    return f"{shown} {one if shown == '1' else many or one + 's'}"
