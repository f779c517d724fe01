"""Reading numbers and column names as people really write them."""

from __future__ import annotations

import re

MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "inf", "+inf", "-inf", "infinity", "+infinity", "-infinity"})
_POINT = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_COMMA = re.compile(r"[+-]?(?:\d+,?\d*|,\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_COLUMN = re.compile(r"^(?P<name>.*?)\s*[\(\[]\s*(?P<unit>[^\)\]]*?)\s*[\)\]]\s*$")


class NotANumber(ValueError):
    """A cell that holds text where a number belongs."""


def parse_number(cell: str, decimal: str = ".") -> float | None:
    """The number in a cell; None where the cell is empty, NaN or infinite.

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


def column_name(header: str) -> tuple[str, str | None]:
    """Normalised column name and the unit in brackets, if any: `Amplitude (mA)` is (`amplitude`, `mA`)."""
    text = header.strip()
    unit: str | None = None
    if (match := _COLUMN.match(text)) is not None:
        text, unit = match["name"], match["unit"] or None
    return re.sub(r"[\s\-./]+", "_", text.strip().lower()).strip("_"), unit


def shown(cell: str, limit: int = 40) -> str:
    """A cell as it may stand in a message: quoted, control characters escaped, cut."""
    return repr(cell if len(cell) <= limit else cell[: limit - 1] + "…")
