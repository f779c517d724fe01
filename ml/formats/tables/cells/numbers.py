"""Reading numbers and column names as people really write them."""

from __future__ import annotations

import re
from collections.abc import Iterable

MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "inf", "+inf", "-inf", "infinity", "+infinity", "-infinity"})
_POINT = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_COMMA = re.compile(r"[+-]?(?:\d+,?\d*|,\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_COLUMN = re.compile(r"^(?P<name>.*?)\s*[\(\[]\s*(?P<unit>[^\)\]]*?)\s*[\)\]]\s*$")
_SPELLING = str.maketrans({"\u00b5": "u", "\u03bc": "u", "\u00b2": "2"})
_ELECTRIC = re.compile(r"(?P<prefix>[num]?)(?P<base>[va])(?:\^|\*\*)?(?P<square>2?)(?P<density>/hz)?")
_WORDS = {"microvolt": "uV", "microvolts": "uV", "millivolt": "mV", "millivolts": "mV", "volt": "V", "volts": "V"}
_WORDS |= {"microampere": "uA", "microamperes": "uA", "milliampere": "mA", "milliamperes": "mA", "milliamp": "mA", "milliamps": "mA"}
_WORDS |= {"device unit": "device units", "device units": "device units", "percent": "%", "pct": "%", "%": "%"}
_WORDS |= {name: name for name in ("fraction", "lsb", "counts")}
_WORDS |= {"db": "dB", "z": "z", "zscore": "z", "z-score": "z", "z score": "z", "a.u.": "a.u.", "au": "a.u.", "arbitrary units": "a.u."}


TIME_COLUMNS = frozenset(
    {
        *(
            "t_s",
            "t",
            "time",
            "time_s",
            "t_sec",
            "seconds",
            "t_ms",
            "time_ms",
            "milliseconds",
            "t_us",
            "time_us",
            "timestamp_us",
            "microseconds",
        ),
        *("timestamp", "datetime", "date_time", "time_utc", "open_fist_s", "open_fist_us", "open_fist"),
        *("minute_start", "start_utc", "minute_start_utc", "start", "start_time", "start_date", "startdate"),
    }
)
"""Names of columns of times, in any table: the line that has one is the header."""

TIME_UNITS = frozenset({"s", "sec", "seconds", "ms", "us", "\u00b5s", "\u03bcs"})


class NotANumber(ValueError):
    """A cell that holds text where a number belongs."""


def parse_number(cell: str, decimal: str = ".") -> float | None:
    """Parse the number in a cell; None where the cell is empty, NaN or infinite.

    Raises:
        NotANumber: anything else, formulas and thousands separators included.
    """
    text = cell.strip()
    if text.lower() in MISSING:
        return None
    pattern = _COMMA if decimal == "," else _POINT
    if pattern.fullmatch(text) is None:
        raise NotANumber(text)
    value = float(text.replace(",", "."))
    return value if value not in (float("inf"), float("-inf")) else None


class Grouping:
    """Search for thousands separators in one column: whether its mark may separate thousands as well as decimals.

    A mark is decimal for sure where another number than three of digits follows it, or a 0 or more than three digits precede it. It is
    decimal, too, where another cell has four digits without one.
    """

    def __init__(self, mark: str) -> None:
        self._mark = mark
        self.decimal = False
        self.plain = False
        self.marked: int | None = None
        self._rows = 0

    def feed(self, cells: Iterable[str]) -> None:
        """Look at further cells of the column, as far as it is not decided."""
        for cell in () if self.decimal else cells:
            text = cell.strip().lstrip("+-")
            whole, mark, rest = text.partition(self._mark)
            if mark:
                self.decimal = not (len(rest) == 3 and rest.isdigit() and whole.isdigit() and 1 <= len(whole) <= 3 and whole[0] != "0")
                self.marked = self._rows if self.marked is None else self.marked
            elif text.isdigit():
                self.decimal = len(text) > 3
                self.plain = True
            self._rows += 1
            if self.decimal:
                return

    def ambiguous(self, delimiter: str) -> bool:
        """Decide whether the mark may separate thousands, in a table whose cells are separated by `delimiter`.

        Next to whole numbers without a mark it may. Without any it may in the tables of the other locale: points in semicolon tables,
        quoted commas in comma tables.
        """
        if self.decimal or self.marked is None:
            return False
        return self.plain or (delimiter, self._mark) in ((";", "."), (",", ","))


def column_name(header: str) -> tuple[str, str | None]:
    """Split a header into its normalised name and the unit in brackets, if any: `Amplitude (mA)` is (`amplitude`, `mA`)."""
    text = header.strip()
    unit: str | None = None
    if (match := _COLUMN.match(text)) is not None:
        text, unit = match["name"], match["unit"] or None
    return re.sub(r"[\s\-./]+", "_", text.strip().lower()).strip("_"), unit


def unit_name(text: str) -> str:
    """Normalise a unit to one spelling: micro signs are `u`, squares `2`, so that `\u00b5V\u00b2` is `uV2`. An unknown unit stays as it is
    written."""
    plain = " ".join(text.translate(_SPELLING).split())
    known = _known_unit(plain)
    return plain if known is None else known


def known_unit(text: str) -> str | None:
    """Find the unit's one spelling; None for a text that is no unit of a trace. A text in a header may as well be a person's name."""
    return _known_unit(" ".join(text.translate(_SPELLING).split()))


def _known_unit(plain: str) -> str | None:
    low = plain.lower()
    if (match := _ELECTRIC.fullmatch(low)) is not None:
        return f"{match['prefix']}{match['base'].upper()}{match['square']}{'/Hz' if match['density'] else ''}"
    return _WORDS.get(low)


def shown(cell: str, limit: int = 40) -> str:
    """Format a cell for a message: quoted, control characters escaped, cut."""
    return repr(cell if len(cell) <= limit else cell[: limit - 1] + "…")
