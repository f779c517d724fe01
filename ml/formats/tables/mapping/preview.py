"""Preview of a table that could not be read: as much of its first lines as may be shown and stored. It is enough to say which column is
which.

Words stay where they are words of the field, numbers where they are measurements; of everything else the shape is left.
"""

from __future__ import annotations

import re
from typing import Any

from ml.formats.recording import UndecodableFile
from ml.formats.source import Source
from ml.formats.tables.cells.delimited import MOST_TITLES
from ml.formats.tables.cells.numbers import MISSING, TIME_UNITS, NotANumber, known_unit, parse_number
from ml.formats.tables.mapping.lines import MOST_COLUMNS, Top, read_top
from ml.formats.tables.mapping.model import header_hash
from ml.formats.tables.removed import is_personal
from ml.qoc import TREMOR_CLASSES

LONGEST_CELL = 40
MOST_SHOWN = 12
"""Lines of a preview."""
MOST_DIGITS = 4
"""Digits before the decimal point of a number that is shown: longer ones may be a number that names a person, or a time."""
LEAST_NUMBERS = 2
HIDDEN = "…"
_LISTED = """
    a acc accel acceleration accelerometer active adaptive adc ain amp ampere amperes amplitude amplitudes amps analog apple arm average
    avg axis band bandpower baseline battery beta bipolar c channel channels class clock cluster code column contact contacts control
    controller cortex counts counter current d data dbs delivered delta device dominant duration dx dy dz e ecog eeg elapsed electrode
    emg end energy epoch error event fft filtered fist fists fraction freq frequency gamma gpi grasp grasps group gyro hand hemisphere
    hertz high hold hz impedance index intensity inv kinetic l ladder lead left length level lfp limit local log low lower m ma mean
    measure measured measurement median micro mild milli milliampere milliamps milliseconds minute minutes mode moderate motor movement
    ms mv n neural no none norm normalized number nv off on open order output p peak percent period phase policy potential power program
    psd pulse r rate raw ratio rec record recording relative right rms row s sample samples sampling sec second seconds segment
    sensing sensor sequence severity share side sig signal slight smoothed spectral spectrum start state step steps stim stimulation stn
    stop strong sync t target tap theta threshold tick ticks time times timestamp total trace tremor trial type ua unit units unix
    unknown upper us utc uv v value values vol volt voltage volts w watch wave wearable width window x y z zeit strom links rechts
    spannung dauer kanal temps gauche droite tiempo canal izquierda derecha tempo sinistra destra tijd
"""
WORDS = frozenset(_LISTED.split())
"""Words of the field, in headers of tables; none of them is a person's name."""
ROW_WORDS = frozenset({*TREMOR_CLASSES, "l", "r", "left", "right"})
_WORD = re.compile(r"[^\W\d_]+")


def preview_of(path: Source, key: bytes) -> dict[str, Any] | None:
    """Make the preview of a table, as plain JSON; None for what is no table that a mapping could read.

    Args:
        path: the uploaded bytes.
        key: secret of the installation, for the hashes of lines that may be the header.

    Returns:
        `width`; `lines`, each with its `number`, screened `cells` and `header`, the keyed hash of the line, where it may name the columns;
        `header_line` and `unit_lines` as they look like.
    """
    try:
        top = read_top(path)
    except UndecodableFile:
        return None
    width = max((len(cells) for _, cells in top.lines), default=0)
    if top.is_log or len(top.lines) < 2 or not 1 <= width <= MOST_COLUMNS:
        return None
    first = next((i for i, (_, cells) in enumerate(top.lines) if is_row(cells, width)), None)
    if first is None or first == 0:
        return None
    units = 1 if first > 1 and _is_units(top.lines[first - 1][1]) else 0
    header = first - 1 - units
    named = top.lines[header][1]
    shown = [_numbers_shown(top, column, first, named[column] if column < len(named) else "") for column in range(width)]
    lines = [
        {
            "number": number,
            "cells": [_cell(cell, i < first and len(cells) == width, i >= first and shown[j]) for j, cell in enumerate(cells)],
            "header": header_hash(cells, key) if number <= MOST_TITLES + 1 and len(cells) == width else None,
        }
        for i, (number, cells) in enumerate(top.lines[: first + MOST_SHOWN])
    ]
    return {"width": width, "lines": lines, "header_line": top.lines[header][0], "unit_lines": units}


def is_row(cells: list[str], width: int) -> bool:
    """Decide whether a line is one of measurements. Such a line has all its cells, and at least half of the non-empty ones are numbers or
    times."""
    filled = [cell for cell in cells if cell.lower() not in MISSING]
    telling = [cell for cell in filled if _number(cell) is not None or _has_date(cell)]
    return len(cells) == width and bool(telling) and 2 * len(telling) >= len(filled)


def _is_units(cells: list[str]) -> bool:
    named = [cell.strip("[]()").strip() for cell in cells if cell not in ("", "-")]
    return bool(named) and all(known_unit(cell) or cell.lower() in TIME_UNITS for cell in named)


def _has_date(cell: str) -> bool:
    return re.search(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}", cell) is not None


def _number(cell: str) -> float | None:
    for decimal in (".", ","):
        try:
            return parse_number(cell, decimal)
        except NotANumber:
            continue
    return None


def _numbers_shown(top: Top, column: int, first: int, name: str) -> bool:
    """Decide whether the numbers of a column are measurements, and none that may name a person.

    Those are whole numbers from 100 on: all one, or in a column whose name has no word of the field.
    """
    if is_personal(name):
        return False
    cells = [cells[column] for _, cells in top.lines[first:] if column < len(cells) and cells[column]]
    found = [n for cell in cells if (n := _number(cell)) is not None]
    if len(found) < LEAST_NUMBERS or 2 * len(found) < len(cells):
        return False
    whole = all(n == int(n) for n in found)
    return not whole or max(map(abs, found)) < 100 or (len(set(found)) > 1 and _has_known_word(name))


def _cell(cell: str, names: bool, measured: bool) -> str:
    """Clean a cell for display: words of the field where it `names` columns, numbers where they were `measured`, else its shape."""
    text = cell.strip()[: 4 * LONGEST_CELL]
    if text.lower() in MISSING | ROW_WORDS:
        return text.lower()
    value = _number(text)
    if value is not None:
        plain = measured and abs(value) < 10**MOST_DIGITS
        return f"{value:.6g}" if plain else re.sub(r"\d", "#", text)[:LONGEST_CELL]
    if names:
        return known_unit(text.strip("[]()")) or _words(text)
    return _tidy(re.sub(r"\d", "#", re.sub(_WORD, lambda w: w[0] if w[0] in "TZ" else HIDDEN, text)))


def _words(text: str) -> str:
    """Clean words: known words and marks stay; other words become `…`, digits `#`. A single digit, such as of a contact, stays with a known
    word."""
    out = re.sub(_WORD, lambda w: w[0] if w[0].lower() in WORDS or known_unit(w[0]) else HIDDEN, _apart(text))
    single = _has_known_word(text) and not re.search(r"\d{2}|\d[./-]\d[./-]\d", out)
    return _tidy(out if single else re.sub(r"\d", "#", out))


def _has_known_word(text: str) -> bool:
    """Decide whether a text has a word of the field of two letters or more."""
    return any(len(w) > 1 and w.lower() in WORDS for w in _WORD.findall(_apart(text)))


def _apart(text: str) -> str:
    """Insert a blank between the words of `likeThis`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)


def _tidy(text: str) -> str:
    """Join several hidden words into one, and remove what a terminal or page would act on."""
    plain = "".join(mark for mark in text if mark.isprintable())
    return re.sub(r"…[\s…]*…", HIDDEN, plain)[:LONGEST_CELL]
