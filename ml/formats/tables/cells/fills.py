"""Fill values of tables: numbers that a writer put where it had none, found by standing far off all others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ml.formats.recording import FileReport

FILLS = (-1, -9, -99, -999, -9999, -99_999, 9_999, 99_999, 999_999, 32_767, -32_768, 65_535, 2**31 - 1, -(2**31), 2**32 - 1)
"""Numbers that statistics programs and devices write for a missing value: repeated nines, and the ends of integers."""

FAR = 10.0
"""A fill value is larger than any other value by this factor. Where values come near to it, it is one of them."""

LINES = 5


def without_fills(role: str, values: NDArray[np.float64], lines: NDArray[np.int64], report: FileReport) -> NDArray[np.float64]:
    """Make the fill values of a column gaps, and report each with its lines.

    A number of `FILLS` is one where it exceeds all other values `FAR` times. A negative one is, too, in a column without other negatives.

    Args:
        role: of the column. values: in the file's unit, [n], NaN where there is none. lines: of the file, [n].
    """
    known = np.isfinite(values)
    filled = known & np.isin(values, FILLS)
    rest = values[known & ~filled]
    if not filled.any() or not rest.size:
        return values
    largest, least = float(np.abs(rest).max()), float(rest.min())
    out = values.copy()
    for fill in sorted(set(values[filled].tolist())):
        if abs(fill) > FAR * largest or (fill < 0 <= least and role != "lfp"):
            rows = np.flatnonzero(values == fill)
            out[rows] = np.nan
            where = ", ".join(map(str, lines[rows[:LINES]].tolist())) + (", …" if rows.size > LINES else "")
            report.flagged.append(f"{rows.size} rows of {role} are {fill:g}, a sign for no value (line {where}): kept as gaps")
    return out
