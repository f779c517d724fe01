"""Sources of one amplitude that differ: what each states, as a recording stores it until a person chooses one of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

CONFLICTS = "amplitude_conflicts"
"""Member of a recording's quality: a list of what `disagreement` returns."""

Piece = tuple[float, float, float]
"""Begin and end in s of the recording, amplitude in mA or NaN."""


def disagreement(from_s: float, to_s: float, sources: Mapping[str, Mapping[str, Sequence[Piece]]]) -> dict[str, Any]:
    """Describe a time in which sources differ, as plain JSON.

    Args:
        from_s, to_s: of the recording; the amplitude is unknown there.
        sources: by name, by channel of the amplitude's trace: what the source states, in order of time.
    """

    def plain(pieces: Sequence[Piece]) -> list[list[float]]:
        return [[round(begin, 3), round(end, 3), value] for begin, end, value in pieces if end > begin and math.isfinite(value)]

    stated = {name: {channel: plain(pieces) for channel, pieces in by.items()} for name, by in sources.items()}
    return {"from_s": round(from_s, 3), "to_s": round(to_s, 3), "sources": stated}


def disagreements_of_rows(
    differ: NDArray[np.bool_], sources: Mapping[str, NDArray[np.float64]], channel: str, first_s: float, period_s: float
) -> list[dict[str, Any]]:
    """Describe each run of rows in which sources differ.

    Args:
        differ: which rows, [rows]. sources: amplitude of each row by source, mA, [rows]. first_s: begin of row 0. period_s: of the rows.
    """
    edges = np.flatnonzero(np.diff(np.concatenate(([0], differ.astype(np.int8), [0]))))
    out = []
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        pieces = {name: {channel: _pieces(values[begin:end], first_s + begin * period_s, period_s)} for name, values in sources.items()}
        out.append(disagreement(first_s + begin * period_s, first_s + end * period_s, pieces))
    return out


def _pieces(values: NDArray[np.float64], begin_s: float, period_s: float) -> list[Piece]:
    """Join rows of one value, [n > 0]."""
    heads = [0, *(np.flatnonzero(np.diff(values) != 0) + 1).tolist(), values.size]
    return [(begin_s + a * period_s, begin_s + b * period_s, float(values[a])) for a, b in pairwise(heads)]
