"""Fast reading of plain tables of numbers, such as a million samples of raw LFP: whole blocks of lines at once, no object per cell.

A line is plain when its used cells are numbers with a decimal point, `nan` or empty, and nothing in it is quoted. Every other table is left
to the reader of `delimited`, which gives the same numbers for plain ones.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from ml.formats.tables.cells.numbers import Grouping

LINES_AT_ONCE = 16_384
LONGEST_LINE = 10_000
_NUMBER = r"(?:[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[nN]a[nN])?"


def read_plain(
    lines: Iterator[str], delimiter: str, width: int, used: Sequence[int], max_rows: int
) -> dict[int, NDArray[np.float64]] | None:
    """Read numbers of the used columns by index, [rows] each, NaN for empty cells; None where a line is not plain or there are too many.

    Args:
        lines: the lines behind the header.
        delimiter: between cells; a point is none.
        width: cells of a line.
        used: columns to read.
        max_rows: rows the table may have.
    """
    other = f'[^"\n{re.escape(delimiter)}]*'
    plain = re.compile(re.escape(delimiter).join(_NUMBER if i in used else other for i in range(width)) + r"\n?")
    blocks: dict[int, list[NDArray[np.float64]]] = {i: [] for i in used}
    groupings = {i: Grouping(".") for i in used}
    rows = 0
    while block := list(islice(lines, LINES_AT_ONCE)):
        rows += len(block)
        if rows > max_rows or max(map(len, block)) > LONGEST_LINE or not all(map(plain.fullmatch, block)):
            return None
        cells = delimiter.join(block).replace("\n", "").split(delimiter)
        for i, grouping in groupings.items():
            grouping.feed(cells[i::width])
        numbers = {i: _floats(cells[i::width]) for i in used}
        # a row without any number may be a blank line, which is no row
        if np.all([np.isnan(x) for x in numbers.values()], axis=0).any():
            return None
        for i, column in numbers.items():
            blocks[i].append(column)
    if any(grouping.ambiguous(delimiter) for grouping in groupings.values()):
        return None
    return {i: np.concatenate(column) if column else np.empty(0) for i, column in blocks.items()}


def _floats(cells: list[str]) -> NDArray[np.float64]:
    column = np.fromiter((float(cell or "nan") for cell in cells), dtype=np.float64, count=len(cells))
    column[~np.isfinite(column)] = np.nan
    return column
