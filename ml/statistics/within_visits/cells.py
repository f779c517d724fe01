"""Sessions counted by visit and arm at once, for sums and means without a loop over visits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Cells:
    """Measured sessions by visit and arm; V visits with both arms, m sessions in them.

    Attributes:
        visit: visit numbers, [V]. rows: of the sessions, [m]. cell: twice the place of the visit, plus 1 for cDBS, [m].
        counts: sessions of the controller and of cDBS, [V, 2].
    """

    visit: Integers
    rows: Integers
    cell: Integers
    counts: Integers

    def sums(self, values: Floats) -> Floats:
        """Sum values [m] by visit and arm, [V, 2]."""
        return np.bincount(self.cell, weights=values, minlength=self.counts.size).astype(np.float64).reshape(-1, 2)

    def means(self, values: Floats) -> Floats:
        """Average values [m] by visit and arm, [V, 2]."""
        return self.sums(values) / self.counts


def cells_of(known: NDArray[np.bool_], visit: Integers, tested: NDArray[np.bool_]) -> Cells:
    """Sort n sessions into cells.

    Args:
        known: which were measured, [n]. visit: numbers, [n]. tested: True for the controller, False for cDBS, [n].
    """
    numbers, place = np.unique(visit[known], return_inverse=True)
    cell = 2 * place + ~tested[known]
    counts = np.bincount(cell, minlength=2 * numbers.size).reshape(-1, 2)
    both = np.minimum(counts[:, 0], counts[:, 1]) > 0
    renumbered = np.cumsum(both) - 1
    counted = both[place]
    return Cells(numbers[both], np.flatnonzero(known)[counted], (2 * renumbered[place] + cell % 2)[counted], counts[both])
