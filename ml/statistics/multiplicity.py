"""Adjustment of p-values for several tests: Holm over a planned family, Benjamini-Hochberg for exploration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down adjustment: the k-th smallest of m p-values times (m - k + 1), never falling, at most 1 (Holm 1979)."""
    order = np.argsort(p_values, kind="stable")
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(np.asarray(p_values)[order] * np.arange(len(p_values), 0, -1)))
    return [float(p) for p in adjusted]


def benjamini_hochberg(p_values: Sequence[float]) -> list[float]:
    """Benjamini and Hochberg's step-up adjustment: the k-th smallest of m p-values times m / k, never falling, at most 1 (1995).

    Rejecting what is at most q keeps the expected share of false rejections at q where the tests are independent or positively dependent.
    """
    m = len(p_values)
    order = np.argsort(p_values, kind="stable")[::-1]
    adjusted = np.empty(m)
    adjusted[order] = np.minimum(1.0, np.minimum.accumulate(np.asarray(p_values, dtype=np.float64)[order] * m / np.arange(m, 0, -1)))
    return [float(p) for p in adjusted]
