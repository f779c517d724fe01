"""Values that a device writes where it has no reading, and the bounds of what each field can measure.

A sentinel is the largest value of the field's integer, or -1. A value that is a sentinel, or outside the bounds, is no reading and becomes
NaN. The facts of each format list its fields (`ml/formats/facts`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

INT16, INT32, UINT32 = 2**15 - 1, 2**31 - 1, 2**32 - 1
UINT8, UINT16 = 2**8 - 1, 2**16 - 1
WIDE = (UINT16, INT32, UINT32, -1)
"""Largest values of integers of 16 and 32 bits, and -1."""


@dataclass(frozen=True, slots=True)
class Field:
    """Values that one field of one format can have.

    Attributes:
        unit: of its values.
        low, high: physical bounds, inclusive.
        sentinels: values that mean `no reading`, whether within the bounds or not.
        source: of the fact.
    """

    unit: str
    low: float
    high: float
    sentinels: tuple[float, ...]
    source: str


def readings(values: NDArray[np.float64], field: Field) -> tuple[NDArray[np.float64], int]:
    """Replace values that are no reading by NaN.

    Args:
        values: any shape, NaN where the file has no number.
        field: that they are of.

    Returns:
        A copy, and how many numbers in it were no readings.
    """
    out = np.array(values, dtype=np.float64)
    wrong = ~np.isnan(out) & ~((out >= field.low) & (out <= field.high))
    for sentinel in field.sentinels:
        wrong |= out == sentinel
    out[wrong] = np.nan
    return out, int(np.sum(wrong))


def reading(value: float | None, field: Field) -> float | None:
    """Return one value, or None where it is no reading."""
    kept = value is not None and field.low <= value <= field.high and value not in field.sentinels
    return value if kept else None
