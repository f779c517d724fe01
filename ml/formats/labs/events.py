"""Rows of a table of events, reduced to labels of marks: what they state of the stimulation, in the words of `marks`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from ml.formats.labs.marks import Side, Statement, clean_text, parse, render
from ml.formats.labs.names import MA
from ml.formats.tables.cells.numbers import MISSING, NotANumber, column_name, known_unit, parse_number

TEXTS = (
    "trial_type", "event_type", "event", "label", "labels", "stim_type", "stim", "stimulation", "dbs", "condition", "type", "state",
    "description", "annotation", "event_name", "name", "value",
)  # fmt: skip
"""Columns whose texts are read as markers, in this order."""
SIDES = ("hemisphere", "hemi", "side", "laterality", "stim_side", "stim_hemisphere")
_AMOUNT = frozenset({"amplitude", "amp", "current", "intensity", "ma", "milliamps"})
_AROUND = frozenset({"stim", "stimulation", "dbs", "of", "the", "in", "ma", "ua", "a", "v"})
_SIDE: dict[str, Side] = {"l": "left", "left": "left", "lh": "left", "r": "right", "right": "right", "rh": "right"}
_UNITS = {"ma": "mA", "milliamps": "mA", "ua": "uA", "v": "V"}


def labels_of(cells: Mapping[str, str], units: Mapping[str, str], key: bytes) -> list[str]:
    """Reduce a row to the labels of its marks: one, or one per side where columns state the amplitude of each.

    An amplitude in a column without a unit, or one that a text of the row contradicts, is unknown.

    Args:
        cells: texts of the row by the header of their column. units: that another file states, by header.
        key: secret of the installation, for unknown words.
    """
    lower = {header.strip().lower(): cell for header, cell in cells.items()}
    said = [parse(clean_text(lower[name], key)) for name in TEXTS if lower.get(name, "").strip().lower() not in MISSING]
    mentions = [one for one in said if one.mentions]
    side = next((_SIDE.get(lower[name].strip().lower()) for name in SIDES if name in lower), None)
    amounts = [found for header, cell in cells.items() if (found := _amount(header, cell, units)) is not None]
    if not mentions and not amounts:
        return [render(next((one for one in said if one.code or one.words), Statement()))]
    text = mentions[0] if mentions else Statement(mentions=True)
    if any(one != text for one in mentions):
        text = replace(text, clear=False)
    if side is not None:
        text = replace(text, side=side, clear=text.clear and text.side in (None, side))
    if not amounts:
        return [render(text)]
    return [render(_join(text, amount)) for amount in amounts]


def _join(text: Statement, amount: Statement) -> Statement:
    """Join the statement of a text with that of a column; where they differ the amplitude is unknown."""
    same = text.amplitude_ma in (None, amount.amplitude_ma) and text.side in (None, amount.side or text.side) and text.volts is None
    side = amount.side or text.side
    return replace(
        text, side=side, amplitude_ma=amount.amplitude_ma, volts=amount.volts, clear=text.clear and amount.clear and same
    )  # fmt: skip


def is_amount(header: str) -> bool:
    """Decide whether a column has the amplitude of the stimulation."""
    words = _words(header)
    return bool(words & _AMOUNT) and words <= _AMOUNT | _AROUND | _SIDE.keys()


def _words(header: str) -> set[str]:
    return {word for word in re.split(r"[\W_]+", header.lower()) if word}


def _amount(header: str, cell: str, units: Mapping[str, str]) -> Statement | None:
    """Read the amplitude of a cell; None where there is none."""
    if not is_amount(header) or cell.strip().lower() in MISSING:
        return None
    words = _words(header)
    unit = known_unit(column_name(header)[1] or "") or known_unit(units.get(header, ""))
    unit = unit or next((_UNITS[word] for word in _UNITS if word in words), None)
    sides = {_SIDE[word] for word in words & _SIDE.keys()}
    side = sides.pop() if len(sides) == 1 else None
    try:
        value = parse_number(cell)
    except NotANumber:
        value = None
    if value is None or unit is None or value < 0:
        return Statement(side=side, mentions=True, clear=False)
    if unit == "V":
        return Statement(side=side, volts=round(value, 3), mentions=True)
    amount = round(value * MA[unit], 3) if unit in MA else 100.0
    return Statement(side=side, amplitude_ma=amount, mentions=True) if amount < 100 else Statement(side=side, mentions=True, clear=False)
