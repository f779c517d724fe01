"""Adjustment of p-values for several tests: Holm over a planned family, Hommel over the outcomes of one verdict, Benjamini-Hochberg for
exploration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def holm(p_values: Sequence[float]) -> list[float]:
    """Apply Holm's step-down adjustment: the k-th smallest of m p-values times (m - k + 1), never falling, at most 1 (Holm 1979)."""
    order = np.argsort(p_values, kind="stable")
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(np.asarray(p_values)[order] * np.arange(len(p_values), 0, -1)))
    return [float(p) for p in adjusted]


def hommel(p_values: Sequence[float]) -> list[float]:
    """Apply Hommel's adjustment: closed testing with Simes' test of every intersection (Hommel 1988; Simes 1986). Never above Holm's.

    Holds its level where the tests are independent or positively dependent, as one-sided tests of outcomes of the same sessions are that
    get worse together.
    """
    p = np.asarray(p_values, dtype=np.float64)
    adjusted = []
    for i in range(p.size):
        # of the intersections of one size that hold i, the one with the largest other p-values is the hardest to reject
        others = np.sort(np.delete(p, i))[::-1]
        adjusted.append(max(_simes(np.append(others[:k], p[i])) for k in range(p.size)))
    return adjusted


def _simes(p: NDArray[np.float64]) -> float:
    """Compute Simes' p of the intersection: the least of m p_(k) / k."""
    return float(np.min(np.sort(p) * p.size / np.arange(1, p.size + 1)))


def benjamini_hochberg(p_values: Sequence[float]) -> list[float]:
    """Apply Benjamini and Hochberg's step-up adjustment: the k-th smallest of m p-values times m / k, never falling, at most 1 (1995).

    Rejecting what is at most q keeps the expected share of false rejections at q where the tests are independent or positively dependent.
    """
    m = len(p_values)
    order = np.argsort(p_values, kind="stable")[::-1]
    adjusted = np.empty(m)
    adjusted[order] = np.minimum(1.0, np.minimum.accumulate(np.asarray(p_values, dtype=np.float64)[order] * m / np.arange(m, 0, -1)))
    return [float(p) for p in adjusted]
